"""Poses of a URDF's links and extents of their shapes, computed before there is a robot."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from robots.chain import motion_table, motions
from robots.rotations import Float64
from robots.shapes import Shape
from robots.urdf import Urdf


def places(tree: Urdf, values: Mapping[str, float]) -> dict[str, Float64]:
    """Return the transform root <- link [4, 4] by link, for values of independent joints [rad or m]; missing ones are
    0.
    """
    frames = {tree.root: np.eye(4)}
    for joint in tree.outwards():
        transform = joint.origin
        if joint.kind != "fixed":
            master, factor, offset = tree.master(joint)
            value = np.array([factor * values.get(master.name, 0.0) + offset])
            transform = motions(value, motion_table(joint.origin, joint)[None])[0]
        frames[joint.child] = frames[joint.parent] @ transform
    return frames


def corners(shapes: Iterable[Shape]) -> dict[str, Float64]:
    """Return by link the corners [n, 3] of the bounding boxes of its shapes, in the link's frame."""
    by_link: dict[str, list[Float64]] = {}
    for shape in shapes:
        by_link.setdefault(shape.link, []).append(
            shape.box_corners() @ shape.origin[:3, :3].T + shape.origin[:3, 3]
        )
    return {link: np.concatenate(boxes) for link, boxes in by_link.items()}
