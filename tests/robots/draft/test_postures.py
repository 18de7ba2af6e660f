from __future__ import annotations

from pathlib import Path

import numpy as np

from robots import load_robot, urdf
from robots.clearance import MARGIN, Clearance
from robots.draft import draft_robot
from robots.draft.postures import PostureSearch, rest_posture
from tests.robots.draft.urdfs import arm, base, jaws, single, write


def test_rest_is_zero_or_as_near_as_limits_allow() -> None:
    lower, upper = np.array([-1.0, 0.0, 1.0, -2.0]), np.array([1.0, 2.0, 3.0, -1.0])
    np.testing.assert_allclose(rest_posture(lower, upper), [0.0, 0.1, 1.1, -1.05])


def test_a_home_in_which_links_touch_is_left_for_the_nearest_that_is_clear(tmp_path: Path) -> None:
    """Two arms 8 cm from each other, upright: bent outwards they are clear, each the mirror image of the other."""
    body = base() + arm("base_link", "l_", xyz="0 0.02 0.1") + arm("base_link", "r_", xyz="0 -0.02 0.1")
    robot = load_robot(draft_robot("mine", write(tmp_path, body), tmp_path / "into").folder)
    home = robot.split(robot.poses["home"])
    assert np.abs(home["left_arm"]).max() > 0.01
    poses = [arm.pose(robot.poses["home"]) for arm in robot.arms]
    np.testing.assert_allclose(poses[0][:3] * [1, -1, 1], poses[1][:3], atol=1e-6)
    assert Clearance(robot).distances(robot.poses["home"]).min() >= MARGIN


def test_fingertips_that_would_be_in_the_table_at_zero_are_lifted(tmp_path: Path) -> None:
    """The arm lies down at zero: its gripper would be 5 cm deep in the table, which is no pair of links."""
    lying = base() + arm("base_link", xyz="0 0 0.2").replace(
        'rpy="0 0 0"/><axis xyz="0 1 0"', 'rpy="0 2.4 0"/><axis xyz="0 1 0"', 1
    )
    made = draft_robot("mine", write(tmp_path, lying + jaws("link6")), tmp_path / "into")
    robot = load_robot(made.folder)
    (only,) = robot.arms
    assert only.tip is not None
    assert (only.transform(np.zeros(robot.dim)) @ only.tip)[2, 3] < -0.05
    for q in robot.poses.values():
        assert (only.transform(q) @ only.tip)[2, 3] >= 0.05
    assert not any("below the table" in warning for warning in made.inspection.warnings)


def test_the_way_from_home_to_ready_is_clear(tmp_path: Path) -> None:
    robot = load_robot(draft_robot("mine", write(tmp_path, single()), tmp_path / "into").folder)
    home, ready = robot.poses["home"], robot.poses["ready"]
    way = home + np.linspace(0, 1, 50)[:, None] * (ready - home)
    assert not np.array_equal(home, ready)
    assert Clearance(robot).distances(way).min() > 0


def test_what_touches_all_the_same_is_named(tmp_path: Path) -> None:
    robot = load_robot(draft_robot("mine", write(tmp_path, single()), tmp_path / "into").folder)
    folded = robot.poses["home"].copy()
    folded[[1, 2]] = 2.4
    postures = PostureSearch(robot, urdf.read(robot.urdf))
    assert postures.touching({"home": robot.poses["home"]}) == ()
    assert ("arm/link1", "arm/link4") in postures.touching({"folded": folded})
