"""Set-ups are compared key by key, and every difference is said with what was given and what is allowed."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import pytest

from evaweb.collect.setups import setup_differences, setup_from_manifest, setup_from_snapshot
from evaweb.core.errors import Conflict
from tests.evaweb.collect.conftest import SETUP, collecting


def changed(**changes: Any) -> dict[str, Any]:
    return {**deepcopy(SETUP), **changes}


def test_the_same_set_up_has_no_difference() -> None:
    assert setup_differences(SETUP, deepcopy(SETUP)) == []


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"robot": "astribot_s1"}, ["robot = astribot_s1, allowed agilex_piper"]),
        ({"fps": 50.0}, ["fps = 50, allowed 30"]),
        ({"groups": []}, ["groups = none, allowed left_arm"]),
        (
            {"joints": ["left_arm.joint0"]},
            ["joints = left_arm.joint0, allowed left_arm.joint0, left_arm.joint1"],
        ),
        (
            {"cameras": {"cam_high": {"width": 640, "height": 480}, "wrist": {"width": 64, "height": 48}}},
            ["camera cam_high = 640x480, allowed 64x48", "camera wrist = 64x48, allowed none"],
        ),
        ({"cameras": {}}, ["camera cam_high = none, allowed 64x48"]),
        (
            {"streams": {**SETUP["streams"], "effort": True}},
            ["recorded = eef, eef_action, effort, allowed eef, eef_action"],
        ),
    ],
)
def test_each_difference_is_a_sentence_of_its_own(changes: dict[str, Any], said: list[str]) -> None:
    assert setup_differences(changed(**changes), SETUP) == said


def test_a_manifest_and_a_snapshot_are_compared_in_the_same_words() -> None:
    manifest = {
        "robot": {"name": "agilex_piper", "joint_names": SETUP["joints"], "dim": 2},
        "cameras": SETUP["cameras"],
        "fps": 30.0,
        "streams": SETUP["streams"],
    }
    assert (
        setup_differences(
            setup_from_manifest(manifest), setup_from_snapshot({"collect": collecting()}, "bench")
        )
        == []
    )


def test_a_station_that_collects_nothing_or_sees_nothing_has_no_set_up() -> None:
    with pytest.raises(Conflict, match=r"no \[collection\]"):
        setup_from_snapshot({"collect": None}, "bench")
    with pytest.raises(Conflict, match="cam_high"):
        setup_from_snapshot({"collect": collecting(setup=None)}, "bench")
