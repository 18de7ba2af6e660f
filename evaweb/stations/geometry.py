"""Static data of the 3D scene: a robot's parts, shapes and frames, its surroundings and the bench."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from django.urls import reverse
from numpy.typing import NDArray

from evaweb.stations.meshes import mesh_in
from evaweb.stations.robot_geometry import DrawnRobot, drawn_robot, tip_of
from evaweb.stations.surroundings import scene_surroundings
from robots import Group
from robots.capsules import capsules
from robots.rotations import transform_of
from robots.shapes import PLAIN
from robots.visuals import Visual
from runtime.benches.appearance import describe_appearance
from runtime.benches.schema import UnusableBench, load_schema

Float64 = NDArray[np.float64]


def scene_geometry(robot: str, groups: Sequence[str] | None = None, *, bench: str = "") -> dict[str, Any]:
    """Return parts, shapes, frames and surroundings of a robot with these groups, and the objects of a simulated bench.

    Matrices are column-major. In a frame, key "part" is None if the frame is fixed in the scene.
    Raises: NotFound for an unknown robot or group.
    """
    drawn = drawn_robot(robot, groups)
    return {
        "robot": robot,
        "groups": [group.name for group in drawn.robot.groups],
        "parts": list(drawn.scene.parts),
        "visuals": [_visual(robot, visual) for visual in drawn.scene.visuals],
        "home": drawn.poses(np.asarray(drawn.robot.poses["home"])).tolist(),
        "tips": [
            {"group": arm.name, "part": drawn.tip_part(arm), "pose": _numbers(tip_of(arm))}
            for arm in drawn.robot.arms
        ],
        "frames": _frames(drawn),
        "capsules": _capsules(drawn),
        **scene_surroundings(drawn),
        "bench": _bench(bench) if bench else None,
    }


def _bench(name: str) -> dict[str, Any] | None:
    """Return how the bench's objects look, None if its folder is not on this machine: they are not drawn then."""
    try:
        return describe_appearance(load_schema(name))
    except UnusableBench:
        return None


def _visual(robot: str, visual: Visual) -> dict[str, Any]:
    """Return a shape; a mesh has an `address` and a `box` that is drawn until it is loaded."""
    document = {"part": visual.part, **_shape(visual), "colour": list(visual.colour)}
    if visual.file is None:
        return document
    mesh = mesh_in(visual.file)
    return {
        **document,
        "format": mesh.format,
        "address": reverse("robot-mesh", args=[robot, mesh.digest]),
        "box": _shape(visual.simple()),
        "own_colours": visual.colour == PLAIN,
    }


def _shape(visual: Visual) -> dict[str, Any]:
    return {"kind": visual.kind, "size": list(visual.size), "origin": _numbers(visual.origin)}


def _frames(drawn: DrawnRobot) -> list[dict[str, Any]]:
    """Return the frames of all end effectors, then the reference frames of their poses, without duplicates."""
    robot = drawn.robot
    frames: dict[int | None, dict[str, Any]] = {}
    for arm in robot.arms:
        assert arm.frame is not None
        part = drawn.scene.link_of(arm.name, arm.frame)
        frames.setdefault(part, _frame(_link(drawn, arm, arm.frame), "reference", part))
    if robot.mount_frame not in ("world", *(frame["name"] for frame in frames.values())):
        frames[None] = _frame(robot.mount_frame, "reference", None, transform_of(robot.stand))
    ends = [_frame(_link(drawn, arm, str(arm.eef_link)), "end", drawn.tip_part(arm)) for arm in robot.arms]
    return [*ends, *frames.values()]


def _link(drawn: DrawnRobot, arm: Group, link: str) -> str:
    """Return the name of a link, with the name of its arm in front if several parts have the same link name."""
    return link if len(drawn.scene.parts_showing(link)) == 1 else f"{arm.name}/{link}"


def _capsules(drawn: DrawnRobot) -> list[dict[str, Any]]:
    """Return the capsules that approximate the links in collision checks."""
    return [
        {"part": part, "start": capsule.start.tolist(), "end": capsule.end.tolist(), "radius": capsule.radius}
        for link, link_capsules in capsules(drawn.robot).items()
        for capsule in link_capsules
        for part in drawn.scene.parts_showing(link)
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
    numbers: list[float] = matrix.T.ravel().tolist()
    return numbers
