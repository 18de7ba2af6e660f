"""What a step, or a way, may do where links are near each other."""

from __future__ import annotations

import numpy as np
import pytest

import robots
from robots import Body, Robot
from robots.rotations import quaternion_of_matrix
from runtime.core.types import Float64
from runtime.kinematics.compiled import CompiledKinematics
from runtime.safety.collision import Collision, Collisions
from tests.runtime.collision_samples import MARGIN, collisions, robot, turned, way

FREE, NEAR, DEEP = turned(0.5), turned(1.2), turned(1.4)


def test_links_that_touch_are_named_with_how_far_they_are_apart() -> None:
    assert collisions().nearest(FREE) is None
    found = collisions().nearest(DEEP)
    assert found is not None
    assert {found.first, found.second} == {"left_arm/gripper_base", "right_arm/gripper_base"}
    assert -0.03 < found.distance < -0.02
    assert str(found) == "left_arm/gripper_base and right_arm/gripper_base would collide (24 mm deep)"
    assert str(Collision("a/b", "table", 0.0031)) == "a/b and table would be 3 mm apart"


def test_the_table_is_one_of_them() -> None:
    low = robot().poses["ready"].copy()
    low[1] = 2.15
    found = collisions().nearest(low)
    assert found is not None
    assert found.first in ("left_arm/link7", "left_arm/link8")  # fingers
    assert found.second == "table"


def fingers_down(robot: Robot, height: float) -> Float64:
    """The first arm's fingertips at that height over the table, pointing down, from its pose `ready` on."""
    arm, q = robot.arms[0], robot.poses["ready"]
    kinematics = CompiledKinematics(robot)
    body = Body(robot)
    frame = body.poses(q)[body.link_of(arm.name, str(arm.frame))]
    assert arm.tip is not None
    tip = frame @ arm.transform(q) @ arm.tip
    down = tip.copy()
    down[:3, 2], down[:3, 1] = (0, 0, -1), (*tip[:2, 1] / np.linalg.norm(tip[:2, 1]), 0)
    down[:3, 0] = np.cross(down[:3, 1], down[:3, 2])
    down[2, 3] = height
    wanted = np.linalg.inv(frame) @ down @ np.linalg.inv(arm.tip)
    targets = kinematics.forward(q)[None]
    targets[0, 0] = [*wanted[:3, 3], *quaternion_of_matrix(wanted[:3, :3])]
    solved = kinematics.solve(targets, q)
    assert solved.position_error[0, 0] < 1e-4
    return np.asarray(solved.q[0])


@pytest.mark.parametrize("name", robots.robot_names())
def test_fingers_come_down_to_the_table_and_are_not_driven_into_it(name: str) -> None:
    made = robots.load_robot(name)
    judged, lowest = Collisions(made, MARGIN), fingers_down(made, 0.002)
    assert judged.nearest(lowest) is None
    found = judged.nearest(fingers_down(made, -0.06))
    assert found is not None
    assert found.second == "table"
    assert found.distance < -0.01


def test_a_margin_is_how_near_counts_as_touching() -> None:
    q = turned(0.95)
    assert collisions(0.0).nearest(q) is None
    assert collisions(0.03).nearest(q) is not None


def test_a_step_into_a_collision_is_found_and_one_out_of_it_or_on_the_spot_is_not() -> None:
    assert collisions().closer_pair(NEAR, FREE) is not None
    assert collisions().closer_pair(DEEP, NEAR) is not None
    assert collisions().closer_pair(NEAR, NEAR) is None
    assert collisions().closer_pair(FREE, NEAR) is None
    parting = turned(1.18)
    assert collisions().nearest(parting) is not None
    assert collisions().closer_pair(parting, NEAR) is None


def test_of_two_pairs_one_may_part_only_while_the_other_does_not_come_nearer() -> None:
    low = turned(1.2)
    low[1] = 2.1
    lower = low.copy()
    lower[0], lower[1] = -1.1, 2.2
    found = collisions().closer_pair(lower, low)
    assert found is not None
    assert found.second == "table"


def test_grippers_open_and_close_freely() -> None:
    closed, opened = turned(1.15, 0.0), turned(1.15, 0.1)
    apart = collisions().nearest(opened)
    assert apart is not None
    shut = collisions().nearest(closed)
    assert shut is None or shut.distance > apart.distance
    assert collisions().closer_pair(opened, closed) is None


def test_a_way_is_free_or_says_where_it_first_is_not() -> None:
    assert collisions().first_on_path(way(turned(0.0), FREE)) is None
    found = collisions().first_on_path(way(FREE, DEEP, FREE))
    assert found is not None
    collision, at = found
    assert collision.distance == pytest.approx(MARGIN, abs=2e-3)
    assert 60 < at < 200


def test_a_way_that_begins_in_a_collision_may_only_part() -> None:
    assert collisions().first_on_path(way(NEAR, FREE)) is None
    assert collisions().first_on_path(way(NEAR, DEEP)) is not None
    found = collisions().first_on_path(way(NEAR, FREE, NEAR))
    assert found is not None
    assert found[1] > 200


def test_a_way_is_judged_with_the_grippers_of_both_its_ends() -> None:
    """They may open at once, or stay closed until the end."""
    closing = way(turned(0.5, 0.1), turned(1.02, 0.0))
    opening = way(turned(0.5, 0.0), turned(1.02, 0.1))
    assert collisions().first_on_path(way(turned(0.5, 0.0), turned(1.02, 0.0))) is None
    assert collisions().first_on_path(closing) is not None
    assert collisions().first_on_path(opening) is not None


def test_standing_still_is_free_wherever_it_is() -> None:
    assert collisions().first_on_path(np.stack([FREE, FREE])) is None
    assert collisions().first_on_path(np.stack([DEEP, DEEP])) is None
