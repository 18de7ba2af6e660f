"""Static data of the 3D scene: a robot's parts, shapes and frames, its surroundings and the bench."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from django.urls import reverse
from numpy.typing import NDArray

from evaweb.stations.meshes import mesh_in
from evaweb.stations.robot_geometry import DrawnRobot, drawn_robot, tip_of
from evaweb.stations.surroundings import BENCH, scene_surroundings
from robots import Group
from robots.capsules import capsules
from robots.rotations import transform_of
from robots.shapes import PLAIN
from robots.visuals import Visual

Float64 = NDArray[np.float64]


def scene_geometry(robot: str, groups: Sequence[str] | None = None, *, simulated: bool) -> dict[str, Any]:
    """Return parts, shapes, frames and surroundings of a robot with these groups.

    Matrices are column-major. A frame's `part` is None if it is fixed in the scene.
    Raises: NotFound for an unknown robot or group.
    """
    looks = drawn_robot(robot, groups)
    return {
        "robot": robot,
        "groups": [group.name for group in looks.robot.groups],
        "parts": list(looks.scene.parts),
        "visuals": [_visual(robot, visual) for visual in looks.scene.visuals],
        "home": looks.poses(np.asarray(looks.robot.poses["home"])).tolist(),
        "tips": [
            {"group": arm.name, "part": looks.tip_part(arm), "pose": _numbers(tip_of(arm))}
            for arm in looks.robot.arms
        ],
        "frames": _frames(looks),
        "capsules": _capsules(looks),
        **scene_surroundings(looks),
        "bench": BENCH if simulated else None,
    }


def _visual(robot: str, visual: Visual) -> dict[str, Any]:
    """Return a shape; a mesh has an `address` and a `box` that is drawn until it is loaded."""
    shown = {"part": visual.part, **_shape(visual), "colour": list(visual.colour)}
    if visual.file is None:
        return shown
    mesh = mesh_in(visual.file)
    return {
        **shown,
        "format": mesh.format,
        "address": reverse("robot-mesh", args=[robot, mesh.digest]),
        "box": _shape(visual.simple()),
        "own_colours": visual.colour == PLAIN,
    }


def _shape(visual: Visual) -> dict[str, Any]:
    return {"kind": visual.kind, "size": list(visual.size), "origin": _numbers(visual.origin)}


def _frames(looks: DrawnRobot) -> list[dict[str, Any]]:
    """Return the end effector of every arm, and each reference frame of its poses once."""
    robot = looks.robot
    found: dict[int | None, dict[str, Any]] = {}
    for arm in robot.arms:
        assert arm.frame is not None
        part = looks.scene.link_of(arm.name, arm.frame)
        found.setdefault(part, _frame(_link(looks, arm, arm.frame), "reference", part))
    if robot.mount_frame not in ("world", *(frame["name"] for frame in found.values())):
        found[None] = _frame(robot.mount_frame, "reference", None, transform_of(robot.stand))
    ends = [_frame(_link(looks, arm, str(arm.eef_link)), "end", looks.tip_part(arm)) for arm in robot.arms]
    return [*ends, *found.values()]


def _link(looks: DrawnRobot, arm: Group, link: str) -> str:
    """Return a link's name, prefixed by its arm's if several parts have that name."""
    return link if len(looks.scene.parts_showing(link)) == 1 else f"{arm.name}/{link}"


def _capsules(looks: DrawnRobot) -> list[dict[str, Any]]:
    """Return the capsules that approximate the links in collision checks."""
    return [
        {"part": part, "start": one.start.tolist(), "end": one.end.tolist(), "radius": one.radius}
        for link, made in capsules(looks.robot).items()
        for one in made
        for part in looks.scene.parts_showing(link)
    ]


def _frame(name: str, kind: str, part: int | None, pose: Float64 | None = None) -> dict[str, Any]:
    return {
        "name": name,
        "kind": kind,
        "part": part,
        "pose": _numbers(np.eye(4) if pose is None else pose),
    }


def _numbers(matrix: Float64) -> list[float]:
    """Return a matrix [4, 4] as 16 numbers in column-major order."""
    found: list[float] = matrix.T.ravel().tolist()
    return found
