"""Where fingertips and links stand in the scene, how far fingers are apart, and what arms reach."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from robots import Group, Robot, scene_of, shapes
from robots.body import Body
from robots.clearance import Clearance
from robots.rotations import Float64, matrix_of_quaternion, quaternion_of_matrix

AREA = (-0.22, 0.22, 0.18, 0.40)  # of the simulated bench: x from, x to, y from, y to [m]
_CORNERS = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))


def tip_in_scene(robot: Robot, arm: Group, q: Float64) -> Float64:
    """The fingertips [4, 4] at the robot's vector q: z the way they point, y the way they open."""
    assert arm.eef_link is not None
    assert arm.tip is not None
    body = Body(robot)
    return np.asarray(body.poses(q)[body.link_of(arm.name, arm.eef_link)] @ arm.tip)


def gap(robot: Robot, arm: Group, q: Float64, links: tuple[str, str]) -> float:
    """How far apart the boxes of two finger links are [m] along the way the fingers open, within 4 cm of the tips."""
    scene = scene_of(robot)
    poses = scene.poses(q)
    inside = np.linalg.inv(tip_in_scene(robot, arm, q))
    sides = []
    for link in links:
        part = scene.link_of(arm.name, link)
        boxes = [visual for visual in scene.visuals if visual.part == part and visual.kind == "box"]
        placed = [inside @ poses[part] @ box.origin for box in boxes]
        corners = [
            (_CORNERS * box.size) @ place[:3, :3].T + place[:3, 3]
            for box, place in zip(boxes, placed, strict=True)
            if abs(place[2, 3]) < 0.04
        ]
        sides.append(np.concatenate(corners)[:, 1])
    low, high = sorted(sides, key=lambda side: float(side.mean()))
    return float(low.max() * -1 + high.min())


def declared_gap(robot: Robot, links: tuple[str, str], opening: float) -> Iterator[tuple[float, float]]:
    """Of each arm at `ready`, the gripper at number `opening`: how far its fingers are apart and ought to be [m]."""
    for arm in robot.arms:
        assert arm.gripper is not None
        assert arm.gripper.apart is not None
        q = robot.poses["ready"].copy()
        q[arm.gripper_dim] = opening
        said = np.interp(opening, (arm.gripper.close, arm.gripper.open), arm.gripper.apart)
        yield gap(robot, arm, q, links), float(said)


def mirror_error(robot: Robot, pose: str) -> tuple[float, float]:
    """How far the right fingertips are from where the left ones are in a mirror: the worst number of place and turn.

    The mirror is the scene's yz-plane. A hand opens to both sides alike: mirrored, its x and y point the other way
    about.
    """
    left, right = (tip_in_scene(robot, arm, robot.poses[pose]) for arm in robot.arms)
    seen = np.diag([-1.0, 1.0, 1.0, 1.0]) @ right @ np.diag([1.0, -1.0, 1.0, 1.0])
    off = np.abs(left - seen)
    return float(off[:3, 3].max()), float(off[:3, :3].max())


def from_home_to_ready(robot: Robot) -> tuple[float, float]:
    """On the straight way: the smallest clearance, and how low fingertips come above the table [m]."""
    way = np.linspace(robot.poses["home"], robot.poses["ready"], 40)
    heights = [tip_in_scene(robot, arm, q)[2, 3] for arm in robot.arms for q in way]
    return float(Clearance(robot).distances(way).min()), float(min(heights))


class Ready(NamedTuple):
    """An arm at `ready`: how far beside the bench's area, off vertical, and from the nearest limit."""

    beside: float  # m
    off_vertical: float  # degrees
    to_limit: float  # rad
    opened: bool


def at_ready(robot: Robot) -> Iterator[Ready]:
    """Every arm."""
    q = robot.poses["ready"]
    for arm in robot.arms:
        assert arm.gripper is not None
        tip, dims = tip_in_scene(robot, arm, q), arm.joint_dims
        yield Ready(
            beside=float(abs(tip[0, 3]) - AREA[1]),
            off_vertical=float(np.degrees(np.arccos(-tip[2, 2]))),
            to_limit=float(np.minimum(q - robot.lower, robot.upper - q)[dims].min()),
            opened=bool(q[arm.gripper_dim] == arm.gripper.open),
        )


def lowest(robot: Robot) -> dict[str, float]:
    """How low each link's drawn shapes come in the scene [m], over all named poses."""
    body, found = Body(robot), dict[str, float]()
    for shape in shapes.read_shapes(robot.urdf):
        corners = np.array([[*corner, 1.0] for corner in itertools.product(*np.transpose(shape.bounds()))])
        for pose in robot.poses.values():
            for part in body.parts_showing(shape.link):
                z = float((body.poses(pose)[part] @ shape.origin @ corners.T)[2].min())
                found[shape.link] = min(found.get(shape.link, np.inf), z)
    return found


def extents(robot: Robot, link: str) -> tuple[Float64, Float64]:
    """The corners [3] of the box around a link's drawn shapes, in the link's frame [m]."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for shape in shapes.read_shapes(robot.urdf):
        if shape.link == link:
            turn, middle = shape.origin[:3, :3], shape.origin[:3, 3]
            if shape.kind == "box":
                reach = np.abs(turn) @ np.array(shape.size) / 2
            else:  # a sphere is a cylinder without length and round at its ends
                along = np.abs(turn[:, 2]) if shape.kind == "cylinder" else np.zeros(3)
                length = shape.size[-1] if shape.kind == "cylinder" else 0.0
                reach = along * length / 2 + shape.size[0] * np.sqrt(np.clip(1 - along**2, 0, 1))
            low, high = np.minimum(low, middle - reach), np.maximum(high, middle + reach)
    return low, high


def unreached(robot: Robot, heights: tuple[float, ...], tilt: float) -> list[tuple[float, float, float]]:
    """The places on a grid over the area to which no arm brings its fingertips, at most `tilt` [rad] off vertical."""
    across, ahead = np.linspace(*AREA[:2], 5), np.linspace(*AREA[2:], 3)
    places = [(float(x), float(y), z) for x in across for y in ahead for z in heights]
    return [
        place
        for place in places
        if not any(reached(robot, arm, place, lean) for lean in (0.0, tilt) for arm in _near(robot, place))
    ]


def reached(robot: Robot, arm: Group, place: tuple[float, float, float], tilt: float) -> bool:
    """Whether the arm brings its fingertips to a place in the scene, pointing down but for `tilt` [rad] outwards.

    Found by minimising what is left of the way over the joints, from `ready` and from `home`.
    """
    assert arm.chain is not None
    assert arm.tip is not None
    assert arm.frame is not None
    chain, dims = arm.chain, arm.joint_dims
    body, ready = Body(robot), robot.poses["ready"]
    base = body.poses(ready)[body.link_of(arm.name, arm.frame)]
    bearing = float(np.arctan2(place[1] - base[1, 3], place[0] - base[0, 3]))
    now = tip_in_scene(robot, arm, ready)
    across = bearing + np.pi / 2 if _turned(now, bearing) else bearing - np.pi / 2
    wanted = np.linalg.inv(base) @ _down(place, across, tilt) @ np.linalg.inv(arm.tip)

    def left(q: Float64) -> Float64:
        found = chain.forward(q)
        turn = quaternion_of_matrix(wanted[:3, :3] @ found[:3, :3].T)
        return np.concatenate([found[:3, 3] - wanted[:3, 3], 0.3 * turn[1:]])

    lower, upper = robot.lower[dims], robot.upper[dims]
    for pose in ("ready", "home"):
        start = np.clip(robot.poses[pose][dims], lower + 0.1, upper - 0.1)
        if np.abs(least_squares(left, start, bounds=(lower, upper), max_nfev=60).fun).max() < 1e-4:
            return True
    return False


def _near(robot: Robot, place: tuple[float, float, float]) -> list[Group]:
    """The arms, first the one whose fingertips are nearest to the place at `ready`."""
    ready = robot.poses["ready"]
    return sorted(
        robot.arms, key=lambda arm: float(np.linalg.norm(tip_in_scene(robot, arm, ready)[:3, 3] - place))
    )


def _turned(tip: Float64, bearing: float) -> bool:
    """Whether the fingers open to the left of the bearing rather than to its right."""
    return bool(tip[:2, 1] @ (-np.sin(bearing), np.cos(bearing)) > 0)


def _down(place: tuple[float, float, float], across: float, tilt: float) -> Float64:
    """Fingertips at a place that point down and open along `across`, tilted about it towards where x points not."""
    y = np.array([np.cos(across), np.sin(across), 0.0])
    x = np.cross(y, (0.0, 0.0, -1.0))
    level = np.column_stack([x, y, (0.0, 0.0, -1.0)])
    turn = matrix_of_quaternion(np.array([np.cos(tilt / 2), 0.0, -np.sin(tilt / 2), 0.0]))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = level @ turn, place
    return pose
