"""What stands around a robot in the scene."""

from __future__ import annotations

import numpy as np
import pytest

import robots
from evaweb.stations.robot_geometry import drawn_robot
from evaweb.stations.surroundings import AREA, bounds, scene_surroundings
from robots.visuals import Visual


def rectangle(table):
    (x, y), (width, depth) = table["centre"], table["size"]
    return x - width / 2, x + width / 2, y - depth / 2, y + depth / 2


@pytest.mark.parametrize("name", robots.robot_names())
def test_things_lie_on_the_table_and_no_body_stands_in_it(name):
    looks = drawn_robot(name)
    found = scene_surroundings(looks)
    x_from, x_to, y_from, y_to = rectangle(found["table"])
    assert x_from <= AREA[0] < AREA[1] <= x_to
    assert y_from <= AREA[2] < AREA[3] <= y_to
    parts = looks.scene.poses(looks.robot.poses["home"])
    for visual in looks.scene.visuals:
        low, high = bounds(visual, parts[visual.part])
        through = low[2] < -found["table"]["thickness"] - 0.05 and high[2] > 0
        beside = high[0] <= x_from or low[0] >= x_to or high[1] <= y_from or low[1] >= y_to
        assert beside or not through


@pytest.mark.parametrize("name", robots.robot_names())
def test_the_whole_robot_is_in_view_in_each_of_its_poses(name):
    looks = drawn_robot(name)
    view = scene_surroundings(looks)["view"]
    for pose in looks.robot.poses.values():
        at = looks.scene.poses(pose)[:, :3, 3]
        shown = {visual.part for visual in looks.scene.visuals}
        middles = np.array([at[part] for part in sorted(shown)])
        assert (middles >= np.array(view["low"]) - 0.1).all()
        assert (middles <= np.array(view["high"]) + 0.1).all()


@pytest.mark.parametrize("name", robots.robot_names())
def test_a_robot_looks_at_the_table(name):
    ahead = scene_surroundings(drawn_robot(name))["ahead"]
    assert np.hypot(*ahead) == pytest.approx(1.0)
    assert ahead[1] > 0.7  # robots stand at the near side


def test_arms_on_the_table_need_neither_floor_nor_mount():
    found = scene_surroundings(drawn_robot("agilex_piper"))
    assert (found["floor"], found["mounts"], found["table"]["legs"]) == (None, [], None)


def test_bases_above_the_table_share_a_mount_that_reaches_them():
    found = scene_surroundings(drawn_robot("dual_franka"))
    assert len(found["mounts"]) == 1
    mount = found["mounts"][0]
    assert mount["from"] == 0.0
    assert mount["to"] > 0.1


@pytest.mark.parametrize(
    ("kind", "size", "low", "high"),
    [
        ("box", (0.2, 0.4, 0.6), [0.7, -0.1, -0.2], [1.3, 0.1, 0.2]),
        ("cylinder", (0.1, 0.6), [0.7, -0.1, -0.1], [1.3, 0.1, 0.1]),
        ("sphere", (0.1,), [0.9, -0.1, -0.1], [1.1, 0.1, 0.1]),
    ],
)
def test_a_turned_shape_fills_what_it_reaches(kind, size, low, high):
    origin = np.eye(4)
    origin[0, 3] = 1.0
    origin[:3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]  # the shape's x, y, z are y, z, x of the scene
    found = bounds(Visual(0, kind, size, origin, (1, 1, 1, 1)), np.eye(4))
    assert np.allclose(found, [low, high])
