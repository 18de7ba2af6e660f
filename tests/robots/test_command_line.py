from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from robots import load_robot
from robots.__main__ import main

Edit = Callable[..., Path]


def test_list_names_the_robots(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list"]) == 0
    assert "agilex_piper  Two AgileX Piper arms" in capsys.readouterr().out


def test_list_goes_on_behind_a_robot_that_cannot_be_loaded_and_fails(
    edited: Edit, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = edited(("control_rate", "rate"))
    monkeypatch.setenv("EVA_ROBOTS", str(folder.parent))
    assert main(["list"]) == 1
    shown = capsys.readouterr()
    assert "ur5e  UR5e" in shown.out
    assert "copy  cannot be loaded: " in shown.err
    assert "unknown key rate" in shown.err


def test_list_says_where_a_robot_of_ones_own_lies(
    edited: Edit, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = edited()
    monkeypatch.setenv("EVA_ROBOTS", str(folder.parent))
    assert main(["list"]) == 0
    assert f"copy  Two AgileX Piper arms with parallel grippers  ({folder})" in capsys.readouterr().out


def test_check_shows_limits_their_source_and_a_home_that_stands_on_one(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["check", "agilex_piper"]) == 0
    shown = capsys.readouterr().out
    assert "limits: joints: position and velocity limits of the URDF" in shown
    joint1 = next(line for line in shown.splitlines() if "left_arm.joint1" in line)
    assert joint1.endswith("home is on a limit")
    assert "right_arm: gripper_base in base_link at home: position 0.05614" in shown


def test_check_of_a_wrong_description_says_what_is_wrong_and_fails(
    edited: Edit, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", str(edited(("control_rate", "rate")))]) == 1
    assert "unknown key rate" in capsys.readouterr().err


def test_check_names_the_links_that_touch_at_a_named_pose_and_fails(
    edited: Edit, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = edited(('["link2", "link4"], ', ""))
    assert main(["check", str(folder)]) == 1
    said = capsys.readouterr().err
    assert (
        f"error: {folder}/robot.toml: poses.home: left_arm/link2 and left_arm/link4 are -18 mm apart" in said
    )


def test_fk_answers_json(capsys: pytest.CaptureFixture[str]) -> None:
    q = ["-1e-3", "0.5", "-0.25", "-.1", "0", "1"]
    assert main(["fk", "agilex_piper", "right_arm", *q]) == 0
    answer = json.loads(capsys.readouterr().out)
    chain = load_robot("agilex_piper").group("right_arm").chain
    assert chain is not None
    pose = chain.pose(np.array([float(value) for value in q]))
    assert answer["position"] == pose[:3].tolist()
    assert answer["wxyz"] == pose[3:].tolist()
    assert (answer["frame"], answer["link"], answer["within_limits"]) == ("base_link", "gripper_base", True)


def test_fk_knows_an_optional_arm(edited: Edit, capsys: pytest.CaptureFixture[str]) -> None:
    folder = edited(('name = "left_arm"', 'name = "left_arm"\noptional = true'))
    assert main(["fk", str(folder), "left_arm", "0", "0", "0", "0", "0", "0"]) == 0
    assert json.loads(capsys.readouterr().out)["position"] == pytest.approx([0.05614, 0.0, 0.21319], abs=1e-4)


def test_fk_says_when_joints_lie_outside_their_limits(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fk", "agilex_piper", "left_arm", "0", "-0.1", "0", "0", "0", "0"]) == 0
    assert json.loads(capsys.readouterr().out)["within_limits"] is False


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["ur9", "left_arm", "0"], "no robot 'ur9'"),
        (["agilex_piper", "head", "0"], "no group 'head'"),
        (["agilex_piper", "left_arm", "0", "0"], "needed: 6 finite numbers"),
        (["agilex_piper", "left_arm"], "needed: 6 finite numbers"),
        (["agilex_piper", "left_arm", "nan", "0", "0", "0", "0", "0"], "needed: 6 finite numbers"),
    ],
)
def test_fk_refuses_what_it_cannot_answer(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["fk", *arguments]) == 1
    assert said in capsys.readouterr().err


def test_fk_of_a_group_without_an_end_effector_is_refused(
    edited: Edit, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = edited(('frame = "base_link"\neef_link = "gripper_base"\n', ""))
    assert main(["fk", str(folder), "left_arm", "0"]) == 1
    assert "left_arm has no end effector; arms: right_arm" in capsys.readouterr().err
