from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from robots import load_robot, shapes, urdf
from robots.draft.geometry import corners
from robots.draft.gripper import GripperDraft, end_link, guess_gripper
from robots.draft.group_guessing import guess_groups
from robots.rotations import matrix_of_quaternion
from tests.robots.draft.urdfs import BOX, arm, base, jaws, joint, link, single, write


def drafted(path: Path) -> tuple[str, GripperDraft]:
    """The first arm's end effector and gripper."""
    tree = urdf.read(path)
    limb = guess_groups(tree)[0]
    eef_link = end_link(tree, limb)
    return eef_link, guess_gripper(tree, limb, eef_link, corners(shapes.read_shapes(path)))


def test_fingers_that_slide_open_by_twice_their_way(tmp_path: Path) -> None:
    eef_link, gripper = drafted(write(tmp_path, single()))
    assert eef_link == "link6"
    assert (gripper.driver, gripper.unit, gripper.placeholder_notes) == ("finger_joint1", "m", ())
    assert (gripper.lower, gripper.upper, gripper.open, gripper.close) == (0.0, 0.04, 0.04, 0.0)
    assert (gripper.velocity, gripper.apart) == (0.2, 0.08)
    assert gripper.fingers == {"finger_joint1": (0.0, 0.04)}
    np.testing.assert_allclose(
        gripper.tip[:3], [0, 0, 0.07], atol=1e-9
    )  # a centimetre before the fingers end
    frame = matrix_of_quaternion(gripper.tip[3:])
    np.testing.assert_allclose(frame[:, 2], [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(np.abs(frame[:, 1]), [0, 1, 0], atol=1e-9)


def test_fingers_without_a_mimic_are_led_against_each_other(tmp_path: Path) -> None:
    """The second one slides the other way along the same axis: its ends are turned round."""
    body = base() + arm("base_link") + jaws("link6", mimic=False)
    body = body.replace(
        '<axis xyz="0 -1 0"/><limit lower="0" upper="0.04"',
        '<axis xyz="0 1 0"/><limit lower="-0.04" upper="0"',
    )
    _, gripper = drafted(write(tmp_path, body))
    assert gripper.fingers == {"finger_joint1": (0.0, 0.04), "finger_joint2": (0.0, -0.04)}
    assert (gripper.open, gripper.apart) == (0.04, 0.08)


def test_a_frame_for_grasping_is_the_end_effector(tmp_path: Path) -> None:
    body = single() + link("tcp") + joint("to_tcp", "link6", "tcp", kind="fixed", xyz="0 0 0.06")
    eef_link, gripper = drafted(write(tmp_path, body))
    assert eef_link == "tcp"
    np.testing.assert_allclose(gripper.tip[:3], [0, 0, 0.01], atol=1e-9)


def test_a_flange_ends_an_arm_without_a_gripper(tmp_path: Path) -> None:
    body = base() + arm("base_link") + link("tool0") + joint("flange", "link6", "tool0", kind="fixed")
    for text, wanted in ((body, "tool0"), (base() + arm("base_link"), "link6")):
        tree = urdf.read(write(tmp_path, text))
        assert end_link(tree, guess_groups(tree)[0]) == wanted


def test_a_jaw_that_turns_against_one_that_stands_still(tmp_path: Path) -> None:
    moving = link("moving", BOX.format(x="0 0 0.05", size="0.01 0.01 0.1"))
    limit = '<limit lower="-0.2" upper="1.6" velocity="3"/>'
    body = (
        base()
        + arm("base_link", count=5)
        + moving
        + joint("jaw", "link5", "moving", axis="1 0 0", more=limit)
    )
    _, gripper = drafted(write(tmp_path, body))
    assert (gripper.unit, gripper.open, gripper.close) == ("rad", 1.6, -0.2)
    assert gripper.apart == pytest.approx(2 * 0.1 * np.sin(0.9), abs=2e-3)  # the chord of the end of the jaw


def test_what_the_urdf_does_not_say_is_a_doubt(tmp_path: Path) -> None:
    limit = '<limit lower="0" upper="0.04" velocity="0.2" effort="10"/>'
    _, gripper = drafted(
        write(tmp_path, single().replace(limit, '<limit lower="0" upper="0" velocity="1000"/>'))
    )
    assert len(gripper.placeholder_notes) == 2
    assert "gives finger_joint1 no range" in gripper.placeholder_notes[0]
    assert "gives finger_joint1 1000/s" in gripper.placeholder_notes[1]
    assert (gripper.lower, gripper.upper, gripper.velocity) == (0.0, 0.04, 0.08)


def test_without_shapes_fingers_are_where_their_origins_are(tmp_path: Path) -> None:
    body = link("base_link") + arm("base_link", visual=False) + jaws("link6")
    body = body.replace(body[body.index("<visual>") : body.index("</visual>") + 9], "")
    tree = urdf.read(write(tmp_path, body))
    limb = guess_groups(tree)[0]
    gripper = guess_gripper(tree, limb, "link6", {})
    assert gripper.apart == 0.08
    np.testing.assert_allclose(gripper.tip[:3], [0, 0, 0.04], atol=1e-9)


@pytest.mark.parametrize("robot", ["agilex_piper", "arx_r5", "dual_franka", "ur5e", "r1_lite", "agibot_g2"])
def test_the_robots_that_come_with_the_program_open_as_far_as_their_descriptions_say(robot: str) -> None:
    described = load_robot(robot)
    first = described.arms[0]
    assert first.gripper is not None
    assert first.tip is not None
    tree = urdf.read(described.urdf)
    limb = guess_groups(tree)[0]
    gripper = guess_gripper(tree, limb, str(first.eef_link), corners(shapes.read_shapes(described.urdf)))
    (low, high), ends = first.gripper.fingers[gripper.driver], (first.gripper.lower, first.gripper.upper)
    opened = low if first.gripper.open == ends[0] else high
    if robot != "agilex_piper":  # which declares more than its fingers do
        assert gripper.apart == pytest.approx(first.gripper.apart[1] - first.gripper.apart[0], abs=0.004)
        assert gripper.open == pytest.approx(opened, abs=1e-3)
    np.testing.assert_allclose(gripper.tip[:3], first.tip[:3, 3], atol=0.0125)
    drafted_axes, axes = matrix_of_quaternion(gripper.tip[3:]), first.tip[:3, :3]
    np.testing.assert_allclose(drafted_axes[:, 2], axes[:, 2], atol=1e-3)
    np.testing.assert_allclose(np.abs(drafted_axes[:, 1]), np.abs(axes[:, 1]), atol=0.03)
