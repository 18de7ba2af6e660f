"""What the 3D scene shows: a robot's parts and shapes, where they are for given joints, and the bench."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

import robots
from evaweb.errors import NotFound

# The simulated bench of runtime.sim.bench, whose sizes a test compares: [m], and colours from 0 to 1.
BENCH = {
    "block_edge": 0.04,
    "plate_radius": 0.075,
    "plate_height": 0.012,
    "area": [-0.22, 0.22, 0.18, 0.40],
    "plate_colour": [226 / 255, 234 / 255, 244 / 255, 1.0],
    "plate_rim_colour": [58 / 255, 104 / 255, 190 / 255, 1.0],
    "block_colours": [
        [226 / 255, 74 / 255, 22 / 255, 1.0],
        [40 / 255, 150 / 255, 70 / 255, 1.0],
        [150 / 255, 70 / 255, 170 / 255, 1.0],
        [235 / 255, 190 / 255, 40 / 255, 1.0],
    ],
}
# Where arms are mounted, seen from above: centre x, y and extents [m]; its surface is z = 0.
TABLE = {
    "centre": [0.0, 0.2],
    "size": [1.2, 0.8],
    "thickness": 0.03,
    "colour": [176 / 255, 164 / 255, 146 / 255, 1.0],
}


@dataclass(frozen=True, slots=True, eq=False)
class Looks:
    """A robot as it is drawn: its description and its scene."""

    robot: robots.Robot
    scene: robots.RobotScene

    def poses(self, q: NDArray[Any]) -> NDArray[np.float32]:
        """World <- part for joints [..., D] as float32 [..., P, 16], each matrix column by column."""
        found = np.swapaxes(self.scene.poses(np.asarray(q, np.float64)), -1, -2)
        return found.reshape(*found.shape[:-2], 16).astype(np.float32)

    def tips(self, links: NDArray[np.float32]) -> NDArray[np.float32]:
        """Where the fingertips are for parts at `links` [..., P, 16]: float32 [..., arms, 3], in the world [m]."""
        arms = [arm for arm in self.robot.arms if arm.tip is not None]
        found = np.empty((*links.shape[:-2], len(arms), 3), np.float32)
        for index, arm in enumerate(arms):
            part = links[..., self.carrier(arm), :].reshape(*links.shape[:-2], 4, 4)  # its columns as rows
            found[..., index, :] = (arm.tip[:, 3] @ part)[..., :3]
        return found

    def carrier(self, arm: robots.Group) -> int:
        """The part that carries an arm's fingertips."""
        return self.scene.part(f"{arm.name}/{arm.eef_link}")

    def facts(self) -> dict[str, Any]:
        """Names of joints and cameras, and the robot's title."""
        return {
            "robot": self.robot.name,
            "title": self.robot.title,
            "joint_names": list(self.robot.joint_names),
            "cameras": [camera.key for camera in self.robot.cameras],
            "rate": self.robot.control_rate,
        }


def facts_of(robot: str) -> dict[str, Any]:
    """The facts of a robot; where its description cannot be read, none but why: stopping must work all the same."""
    try:
        return looks_of(robot).facts()
    except (NotFound, robots.RobotError) as error:
        return {"robot": robot, "title": robot, "joint_names": [], "cameras": [], "error": str(error)}


@cache
def looks_of(robot: str) -> Looks:
    """The looks of a robot that comes with the program; NotFound lists them."""
    if robot not in robots.names():  # a name, never a path: it may come from an address
        raise NotFound(f"robot {robot!r:.80} does not exist; there are: {', '.join(robots.names())}")
    described = robots.load(robot)
    return Looks(described, robots.scene_of(described))


def geometry(robot: str, *, simulated: bool) -> dict[str, Any]:
    """Everything that the 3D scene needs once: parts, shapes, table, and the bench of a simulated station."""
    looks = looks_of(robot)
    return {
        "robot": robot,
        "parts": list(looks.scene.parts),
        "visuals": [
            {
                "part": visual.part,
                "kind": visual.kind,
                "size": list(visual.size),
                "origin": visual.origin.T.ravel().tolist(),
                "colour": list(visual.colour),
            }
            for visual in looks.scene.visuals
        ],
        "home": looks.poses(np.asarray(looks.robot.poses["home"])).tolist() if _has_home(looks) else None,
        "tips": _tips(looks),
        "table": TABLE,
        "bench": BENCH if simulated else None,
    }


def _tips(looks: Looks) -> list[dict[str, Any]]:
    """For each arm the point between its fingertips, z the way they point, in the part that carries it."""
    return [
        {
            "group": arm.name,
            "part": looks.carrier(arm),
            "pose": arm.tip.T.ravel().tolist(),
        }
        for arm in looks.robot.arms
        if arm.tip is not None
    ]


def _has_home(looks: Looks) -> bool:
    return "home" in looks.robot.poses
