"""The robot of an episode, as it was then."""

from __future__ import annotations

from typing import Any

import pytest

import robots
from evaweb.core.errors import NotFound
from evaweb.episodes.manifest_robot import drawn_robot_for, groups_of_manifest, robot_of_manifest


def manifest(*groups: str, **said: Any) -> dict[str, Any]:
    robot = robots.load_robot("agilex_piper", groups or None)
    return {"robot": {"name": robot.name, "dim": robot.dim, "joint_names": list(robot.joint_names), **said}}


def test_the_groups_are_those_of_the_recorded_joints() -> None:
    assert groups_of_manifest(manifest("right_arm")) == ("right_arm",)
    assert drawn_robot_for(manifest("right_arm")).robot.dim == 7
    assert drawn_robot_for(manifest()).robot.dim == 14


def test_an_old_recording_without_names_is_of_the_robot_with_all_its_groups() -> None:
    assert groups_of_manifest(manifest(joint_names=None)) is None
    assert drawn_robot_for(manifest(joint_names=None)).robot.dim == 14


@pytest.mark.parametrize(
    ("said", "sentence"),
    [
        ({"name": "retired"}, "there are: .*agilex_piper"),
        ({"name": "../agilex_piper"}, "there are: .*agilex_piper"),
        ({"name": ""}, "there are: .*agilex_piper"),
        ({"dim": 13}, "the episode has 13 joints, agilex_piper has 14 today"),
        ({"joint_names": ["tail.joint0"]}, "tail"),
        ({"joint_names": [f"left_arm.{k}" for k in range(7)], "dim": 7}, "other names, or another order"),
    ],
)
def test_what_cannot_be_shown_says_why(said: dict[str, Any], sentence: str) -> None:
    with pytest.raises(NotFound, match=sentence):
        drawn_robot_for(manifest(**said))


@pytest.mark.parametrize("broken", [{}, {"robot": None}, {"robot": "agilex_piper"}])
def test_a_manifest_without_a_robot_has_none(broken: dict[str, Any]) -> None:
    assert robot_of_manifest(broken) == {}
    with pytest.raises(NotFound):
        drawn_robot_for(broken)
