"""Where the parts of a robot are, compiled, compared with what the body computes."""

from __future__ import annotations

import numpy as np
import pytest

import robots
from runtime.kinematics.base import KinematicsError
from runtime.kinematics.kernels.link_poses import compute_link_poses
from runtime.kinematics.links import LinkPoses


@pytest.mark.parametrize("name", robots.robot_names())
def test_every_part_is_where_the_body_says_column_by_column(name: str) -> None:
    robot = robots.load_robot(name)
    body = robots.Body(robot)
    span = np.minimum(robot.upper, 4.0) - np.maximum(robot.lower, -4.0)
    q = (
        np.maximum(robot.lower, -4.0)
        - 0.1
        + np.random.default_rng(0).uniform(size=(3, 2, robot.dim)) * (span + 0.2)
    )
    placed = LinkPoses(body).poses(q)
    assert placed.dtype == np.float32
    assert placed.shape == (3, 2, len(body.parts), 16)
    expected = np.swapaxes(body.poses(q), -1, -2).reshape(placed.shape)
    np.testing.assert_allclose(placed, expected, atol=5e-7)


def test_joints_of_any_kind_of_array_are_taken_without_compiling_again() -> None:
    robot = robots.load_robot("agilex_piper")
    links = LinkPoses(robots.Body(robot))
    known = len(compute_link_poses.signatures)  # type: ignore[attr-defined]
    home = robot.poses["home"]
    expected = links.poses(home)
    for given in (home.tolist(), home.astype(np.float32), np.repeat(home, 2)[::2], np.asfortranarray(home)):
        np.testing.assert_array_equal(links.poses(given), expected)
    assert len(compute_link_poses.signatures) == known  # type: ignore[attr-defined]


def test_joints_of_another_width_are_refused() -> None:
    links = LinkPoses(robots.Body(robots.load_robot("agilex_piper")))
    with pytest.raises(KinematicsError, match=r"shape \(2, 7\) were given; allowed: \[\.\.\., 14\]"):
        links.poses(np.zeros((2, 7)))
