"""Boxes that end effectors must stay in."""

from __future__ import annotations

import numpy as np

import robots
from runtime.core.types import Float64
from runtime.safety.filter import WorkspaceBox
from runtime.safety.workspace import Workspace
from tests.runtime.collision_samples import way


def posture(left: float = 0.0) -> Float64:
    q = robots.load_robot("agilex_piper").poses["ready"].copy()
    q[0] += left
    return q


def about_left(half: float) -> Workspace:
    """A box about where the left arm's end effector is in `ready`."""
    robot = robots.load_robot("agilex_piper")
    here = robot.group("left_arm").pose(posture())[:3]
    return Workspace(
        robot, {"left_arm": WorkspaceBox(lower=(here - half).tolist(), upper=(here + half).tolist())}
    )


def test_the_arms_that_are_outside_are_named_and_those_without_a_box_never_are() -> None:
    box = about_left(0.05)
    assert box.arms == ("left_arm",)
    assert box(posture()) == ()
    assert box(posture(1.2)) == ("left_arm",)
    assert box.is_outside(np.stack([posture(), posture(1.2)])).tolist() == [[False], [True]]


def test_no_box_is_left_where_there_is_none() -> None:
    bare = Workspace(robots.load_robot("agilex_piper"), {})
    assert bare(posture()) == ()
    assert bare.arm_leaving_on(way(posture(), posture(1.2))) == ""


def test_a_way_may_come_into_the_box_and_not_leave_it() -> None:
    box = about_left(0.05)
    inside, outside = posture(), posture(1.2)
    assert box.arm_leaving_on(way(inside, posture(0.02))) == ""
    assert box.arm_leaving_on(way(outside, inside)) == ""
    assert box.arm_leaving_on(way(inside, outside)) == "left_arm"
    assert box.arm_leaving_on(way(outside, inside, outside)) == "left_arm"


def test_a_box_is_in_the_declared_frame_of_an_arm_that_others_carry() -> None:
    robot = robots.load_robot("r1_lite", ["left_arm", "torso"])
    arm, q = robot.arms[0], robot.poses["home"]
    x, y, z = arm.pose(q)[:3]
    box = WorkspaceBox(lower=[x - 0.01, y - 0.01, z - 0.01], upper=[x + 0.01, y + 0.01, z + 0.01])
    assert Workspace(robot, {arm.name: box})(q) == ()
    bent = q.copy()
    bent[arm.carrier_dims] += 0.3
    assert Workspace(robot, {arm.name: box})(bent) == (arm.name,)
