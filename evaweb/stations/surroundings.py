"""Surroundings of a robot in the scene: table, floor, mounts, and the direction from robot to table.

The scene is that of the default bench: z = 0 is the surface of the table, objects lie within its `area`. A robot
whose body reaches below the table stands on a floor, and the table is cut so that it does not touch the body.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evaweb.stations.robot_geometry import DrawnRobot
from robots import urdf
from robots.visuals import Visual
from runtime.benches.appearance import shade
from runtime.benches.schema import load_schema

Float64 = NDArray[np.float64]
Rectangle = tuple[float, float, float, float]  # x from, to, y from, y to [m]

_TABLETOP = load_schema("tabletop")
_X_FROM, _X_TO, _Y_FROM, _Y_TO = _TABLETOP.area
AREA: Rectangle = (_X_FROM, _X_TO, _Y_FROM, _Y_TO)  # area for objects
_WOOD = shade(_TABLETOP.table_colour)
_STEEL = [96 / 255, 102 / 255, 110 / 255, 1.0]
_THICKNESS = 0.03
_LEAST_TABLE: Rectangle = (-0.6, 0.6, -0.2, 0.6)  # AREA with a margin
_CLEAR = 0.03  # distance between table and body [m]
_FOOT = 0.15  # margin of the table around an arm's base [m]
_BELOW = -0.05  # height below which a body stands on the floor [m]
_ABOVE = 0.04  # height above which a base has a mount [m]
_RADIUS = 0.055  # radius of a mount [m]
_ONE_MOUNT = 0.3  # distance below which bases share a mount [m]
_NOWHERE = 0.05  # distance from base to area below which the direction is undefined [m]


class Box(NamedTuple):
    """Axis-aligned bounding box in the scene: corners [3] in m."""

    low: Float64
    high: Float64


def scene_surroundings(looks: DrawnRobot) -> dict[str, Any]:
    """Return `table`, `mounts`, `floor` (its height or None), `ahead` [2] and `view` (volume to be visible)."""
    boxes = _at_poses(looks)
    home = boxes[0]
    floor = _floor(looks, home)
    table = _table(looks, home)
    return {
        "table": _drawn(table, floor),
        "mounts": _mounts(looks, table, floor),
        "floor": floor,
        "ahead": _ahead(looks),
        "view": _view([box for pose in boxes for box in pose]),
    }


def bounds(visual: Visual, part: Float64) -> Box:
    """Return the bounding box in the scene of a shape that belongs to a part of the robot.

    `part` is the pose of that part in the scene, as a homogeneous matrix [4, 4].
    """
    low, high = visual.bounds()
    placed = part @ visual.origin
    middle = placed[:3, :3] @ ((low + high) / 2) + placed[:3, 3]
    reach = np.abs(placed[:3, :3]) @ ((high - low) / 2)
    return Box(middle - reach, middle + reach)


def _at_poses(drawn: DrawnRobot) -> list[list[Box]]:
    """Return the boxes of the robot's shapes in each of its named poses, home first."""
    named = drawn.robot.poses
    boxes = []
    for name in sorted(named, key=lambda name: name != "home"):
        parts = drawn.scene.poses(named[name])
        boxes.append([bounds(visual, parts[visual.part]) for visual in drawn.scene.visuals])
    return boxes


def _roots(drawn: DrawnRobot) -> list[Float64]:
    """Return the positions [3] at which the arms are mounted, at the home pose.

    A robot may consist of several copies of its URDF, for example one per arm. Each copy has a root link, whose
    position is returned.
    """
    root = urdf.read(drawn.robot.urdf).root
    poses = drawn.scene.poses(drawn.robot.poses["home"])
    return [poses[part, :3, 3] for part in drawn.scene.parts_showing(root)]


def _floor(drawn: DrawnRobot, home: Sequence[Box]) -> float | None:
    """Return the height of the floor on which the robot stands [m]; None for a robot on a table."""
    lowest = min([*(box.low[2] for box in home), *(root[2] for root in _roots(drawn))], default=0.0)
    return float(lowest) if lowest < _BELOW else None


def _table(drawn: DrawnRobot, home: Sequence[Box]) -> Rectangle:
    """Return the table as (x from, x to, y from, y to) [m].

    The table extends under every base of the robot that stands on the table. Where a part of the robot's body reaches
    below the table, the table is cut so that it does not touch this part. `home` has the bounding boxes of the body at
    the home pose.
    """
    x_from, x_to, y_from, y_to = _LEAST_TABLE
    for x, y, z in _roots(drawn):
        if z > _BELOW:
            x_from, x_to = min(x_from, x - _FOOT), max(x_to, x + _FOOT)
            y_from, y_to = min(y_from, y - _FOOT), max(y_to, y + _FOOT)
    table = (float(x_from), float(x_to), float(y_from), float(y_to))
    for box in home:
        if box.low[2] < _BELOW:
            table = _clear_of(table, box)
    return table


def _clear_of(table: Rectangle, box: Box) -> Rectangle:
    """Return the largest part of the table that avoids `box` and contains AREA; the whole table if there is none."""
    x_from, x_to, y_from, y_to = table
    (x_low, y_low), (x_high, y_high) = box.low[:2] - _CLEAR, box.high[:2] + _CLEAR
    if x_high <= x_from or x_low >= x_to or y_high <= y_from or y_low >= y_to:
        return table
    cuts = [
        (float(x_high), x_to, y_from, y_to),
        (x_from, float(x_low), y_from, y_to),
        (x_from, x_to, float(y_high), y_to),
        (x_from, x_to, y_from, float(y_low)),
    ]
    usable = [cut for cut in cuts if _contains(cut, AREA)]
    return max(usable, key=lambda cut: (cut[1] - cut[0]) * (cut[3] - cut[2]), default=table)


def _contains(table: Rectangle, area: Rectangle) -> bool:
    x_from, x_to, y_from, y_to = table
    return x_from <= area[0] and x_to >= area[1] and y_from <= area[2] and y_to >= area[3]


def _drawn(table: Rectangle, floor: float | None) -> dict[str, Any]:
    x_from, x_to, y_from, y_to = table
    return {
        "centre": [(x_from + x_to) / 2, (y_from + y_to) / 2],
        "size": [x_to - x_from, y_to - y_from],
        "thickness": _THICKNESS,
        "colour": _WOOD,
        "legs": None if floor is None else -floor,
    }


def _mounts(drawn: DrawnRobot, table: Rectangle, floor: float | None) -> list[dict[str, Any]]:
    """Return a column under each base above the table; bases close to each other share one."""
    near: list[list[Float64]] = []
    for root in _roots(drawn):
        if root[2] < _ABOVE:
            continue
        shared = [many for many in near if np.linalg.norm(many[0][:2] - root[:2]) < _ONE_MOUNT]
        if shared:
            shared[0].append(root)
        else:
            near.append([root])
    return [_mount(np.array(many), table, floor) for many in near]


def _mount(roots: Float64, table: Rectangle, floor: float | None) -> dict[str, Any]:
    x, y, top = roots.mean(axis=0).tolist()
    x_from, x_to, y_from, y_to = table
    on_table = floor is None or (x_from < x < x_to and y_from < y < y_to)
    return {"at": [x, y], "from": 0.0 if on_table else floor, "to": top, "radius": _RADIUS, "colour": _STEEL}


def _ahead(drawn: DrawnRobot) -> list[float]:
    """Return the horizontal unit vector [2] from the bases to the middle of AREA."""
    x_from, x_to, y_from, y_to = AREA
    direction = np.array([x_from + x_to, y_from + y_to]) / 2 - np.mean(_roots(drawn), axis=0)[:2]
    length = float(np.linalg.norm(direction))
    return [0.0, 1.0] if length < _NOWHERE else (direction / length).tolist()


def _view(boxes: Sequence[Box]) -> dict[str, list[float]]:
    """Return the volume that the 3D view has to show, as its corners "low" and "high" [3] in m.

    It contains `boxes`, the bounding boxes of the robot in each of its named poses, and AREA, where objects may lie.
    """
    x_from, x_to, y_from, y_to = AREA
    low = [np.array([x_from, y_from, 0.0]), *(box.low for box in boxes)]
    high = [np.array([x_to, y_to, 0.0]), *(box.high for box in boxes)]
    return {"low": np.min(low, axis=0).tolist(), "high": np.max(high, axis=0).tolist()}
