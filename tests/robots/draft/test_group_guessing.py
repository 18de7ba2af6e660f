from __future__ import annotations

from pathlib import Path

import pytest

from robots import RobotError, load_robot, urdf
from robots.draft.group_guessing import GroupGuess, guess_groups
from tests.robots.draft.urdfs import arm, base, dual, jaws, joint, link, single, write


def limbs(folder: Path, body: str) -> dict[str, GroupGuess]:
    return {limb.name: limb for limb in guess_groups(urdf.read(write(folder, body)))}


def test_one_arm_with_a_gripper(tmp_path: Path) -> None:
    found = limbs(tmp_path, single())
    assert list(found) == ["arm"]
    assert found["arm"].joints == tuple(f"joint{number}" for number in range(1, 7))
    assert (found["arm"].fingers, found["arm"].above) == (("finger_joint1",), "base_link")


def test_an_arm_without_a_gripper(tmp_path: Path) -> None:
    found = limbs(tmp_path, base() + arm("base_link"))
    assert [(limb.name, limb.kind, limb.fingers) for limb in found.values()] == [("arm", "arm", ())]


def test_two_arms_torso_head_and_wheels(tmp_path: Path) -> None:
    found = limbs(tmp_path, dual())
    assert list(found) == ["left_arm", "right_arm", "torso", "head", "base"]
    assert found["left_arm"].joints[0] == "l_joint1"
    assert found["right_arm"].fingers == ("r_finger_joint1",)
    assert found["left_arm"].above == found["head"].above == "torso2"
    assert found["torso"].joints == ("lift", "waist")
    assert found["head"].joints == ("neck_yaw", "neck_pitch")
    assert (found["base"].joints, found["base"].wheels) == ((), ("wheel_joint1", "wheel_joint2"))


def test_fingers_that_move_each_by_themselves_are_one_gripper(tmp_path: Path) -> None:
    body = base() + arm("base_link") + jaws("link6", mimic=False)
    assert limbs(tmp_path, body)["arm"].fingers == ("finger_joint1", "finger_joint2")


def test_two_sliding_leaves_are_fingers_whatever_their_names(tmp_path: Path) -> None:
    body = base() + arm("base_link") + jaws("link6", mimic=False)
    body = body.replace("finger_joint1", "joint7").replace("finger_joint2", "joint8")
    assert limbs(tmp_path, body)["arm"].fingers == ("joint7", "joint8")


def test_a_turning_jaw_is_a_gripper_by_its_name(tmp_path: Path) -> None:
    body = base() + arm("base_link", count=5) + link("moving") + joint("Jaw", "link5", "moving", axis="1 0 0")
    assert limbs(tmp_path, body)["arm"].fingers == ("Jaw",)
    nameless = limbs(tmp_path, body.replace('"Jaw"', '"joint6"'))
    assert (nameless["arm"].fingers, len(nameless["arm"].joints)) == ((), 6)


def test_two_turning_leaves_behind_an_arm_are_fingers_and_before_one_are_not(tmp_path: Path) -> None:
    leaves = link("a") + link("b")
    behind = joint("j7", "link6", "a", axis="1 0 0") + joint("j8", "link6", "b", axis="1 0 0")
    assert limbs(tmp_path, base() + arm("base_link") + leaves + behind)["arm"].fingers == ("j7", "j8")
    before = behind.replace('"link6"', '"base_link"')
    found = limbs(tmp_path, base() + arm("base_link") + leaves + before)
    assert found["arm"].fingers == ()
    assert [found["other1"].joints, found["other2"].joints] == [("j7",), ("j8",)]


def test_many_fingers_are_a_hand_of_their_own(tmp_path: Path) -> None:
    body = base() + arm("base_link", "left_")
    for finger in ("thumb", "index_finger", "middle_finger"):
        body += link(f"{finger}1") + link(f"{finger}2")
        body += joint(f"left_{finger}_1", "left_link6", f"{finger}1", axis="1 0 0")
        body += joint(f"left_{finger}_2", f"{finger}1", f"{finger}2", axis="1 0 0", xyz="0 0 0.03")
    found = limbs(tmp_path, body)
    assert list(found) == ["left_arm", "left_hand"]
    assert found["left_arm"].fingers == ()
    assert len(found["left_hand"].joints) == 6


def test_sides_come_from_where_arms_begin_where_names_tell_none(tmp_path: Path) -> None:
    body = base() + arm("base_link", "a_", xyz="0 -0.3 0.1") + arm("base_link", "b_", xyz="0 0.3 0.1")
    found = limbs(tmp_path, body)
    assert [found["left_arm"].joints[0], found["right_arm"].joints[0]] == ["b_joint1", "a_joint1"]
    stacked = base() + arm("base_link", "a_") + arm("base_link", "b_", xyz="0 0 0.4")
    assert list(limbs(tmp_path, stacked)) == ["arm1", "arm2"]


def test_a_lift_in_one_row_with_an_arm_is_a_torso_and_a_first_joint_called_waist_is_not(
    tmp_path: Path,
) -> None:
    lift = link("carriage") + joint("lift", "base_link", "carriage", kind="prismatic")
    found = limbs(tmp_path, base() + lift + arm("carriage"))
    assert [found["torso"].joints, found["arm"].above] == [("lift",), "carriage"]
    waist = limbs(tmp_path, base() + arm("base_link").replace('"joint1"', '"waist"'))
    assert list(waist) == ["arm"]
    assert waist["arm"].joints[0] == "waist"


def test_an_arm_begins_on_what_a_root_that_is_only_the_world_carries(tmp_path: Path) -> None:
    body = link("world") + base() + joint("stand", "world", "base_link", kind="fixed") + arm("base_link")
    assert limbs(tmp_path, body)["arm"].above == "base_link"


def test_a_head_alone_is_a_head(tmp_path: Path) -> None:
    body = base() + link("a") + link("b") + joint("head_pan", "base_link", "a") + joint("head_tilt", "a", "b")
    assert [(limb.name, limb.kind) for limb in limbs(tmp_path, body).values()] == [("head", "head")]


def test_what_does_not_move_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RobotError, match="no joint moves by itself; needed: at least one"):
        limbs(tmp_path, base() + link("lamp") + joint("bolt", "base_link", "lamp", kind="fixed"))


@pytest.mark.parametrize(
    ("robot", "names"),
    [
        ("agilex_piper", ["arm"]),
        ("arx_r5", ["arm"]),
        ("dual_franka", ["arm"]),
        ("ur5e", ["arm"]),
        ("r1_lite", ["left_arm", "right_arm", "torso", "base"]),
        ("agibot_g2", ["left_arm", "right_arm", "torso", "head", "base"]),
    ],
)
def test_the_robots_that_come_with_the_program_are_seen_as_they_are(robot: str, names: list[str]) -> None:
    """Their own URDFs suggest the joints that their descriptions name."""
    described = load_robot(robot)
    found = guess_groups(urdf.read(described.urdf))
    assert [limb.name for limb in found] == names
    for limb, described_arm in zip(found, described.arms, strict=False):
        assert limb.joints == described_arm.urdf_joints
        assert described_arm.gripper is not None
        assert set(limb.fingers) == set(described_arm.gripper.fingers)
