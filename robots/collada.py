"""Reader of the points of a COLLADA file, placed as in its scene [m]; appearance is ignored."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from robots.errors import RobotError
from robots.rotations import Float64
from robots.urdf import parsed

_NAMESPACE = "{*}"
_MOST_NODES = 20_000  # limit, because a few lines can reference a node a billion times


def read_points(path: Path) -> Float64:
    """Return all points [n, 3] of the geometries in the scene, in metres.

    The file's up axis is ignored, as in other viewers of robots.

    Raises:
        ValueError: If it is not COLLADA.
    """
    try:
        root = parsed(path)
    except RobotError as error:
        raise ValueError(str(error.__cause__ or error)) from error
    geometries = {
        f"#{element.get('id')}": _positions(element) for element in root.iterfind(f".//{_NAMESPACE}geometry")
    }
    library = {f"#{element.get('id')}": element for element in root.iterfind(f".//{_NAMESPACE}node")}
    unit = root.find(f"{_NAMESPACE}asset/{_NAMESPACE}unit")
    metres = 1.0 if unit is None else float(unit.get("meter", "1"))
    visits = iter(range(_MOST_NODES))
    parts = [
        geometries[url] @ place[:3, :3].T + place[:3, 3]
        for scene in root.iterfind(f".//{_NAMESPACE}visual_scene")
        for node in scene.iterfind(f"{_NAMESPACE}node")
        for url, place in _instances(node, np.eye(4), library, 0, visits)
        if url in geometries
    ]
    return np.concatenate(parts) * metres if parts else np.empty((0, 3))


def _positions(geometry: ET.Element) -> Float64:
    """Return the points [n, 3] of a geometry's meshes."""
    sources = {f"#{child.get('id')}": child for child in geometry.iterfind(f".//{_NAMESPACE}source")}
    parts = []
    for element in geometry.iterfind(f".//{_NAMESPACE}vertices/{_NAMESPACE}input"):
        source = sources.get(element.get("source", ""))
        numbers = None if source is None else source.find(f"{_NAMESPACE}float_array")
        if element.get("semantic") == "POSITION" and numbers is not None:
            parts.append(np.array((numbers.text or "").split(), dtype=np.float64).reshape(-1, 3))
    return np.concatenate(parts) if parts else np.empty((0, 3))


def _instances(
    node: ET.Element, above: Float64, library: dict[str, ET.Element], depth: int, visits: Iterator[int]
) -> Iterator[tuple[str, Float64]]:
    """Yield the geometries of a node and its descendants with their transforms; `visits` limits the number of nodes."""
    if next(visits, None) is None:
        raise ValueError(f"more than {_MOST_NODES} nodes, with those that it shows again")
    if depth > 64:
        raise ValueError("nodes that contain each other")
    place = above
    for element in node:
        kind = element.tag.rpartition("}")[2]
        if kind in ("matrix", "translate", "rotate", "scale"):
            place = place @ _motion(kind, np.array((element.text or "").split(), dtype=np.float64))
    for element in node:
        kind = element.tag.rpartition("}")[2]
        if kind == "instance_geometry":
            yield element.get("url", ""), place
        elif kind == "node":
            yield from _instances(element, place, library, depth + 1, visits)
        elif kind == "instance_node" and (target := library.get(element.get("url", ""))) is not None:
            yield from _instances(target, place, library, depth + 1, visits)


def _motion(kind: str, numbers: Float64) -> Float64:
    """Return the transform [4, 4] of an element of that kind ("matrix", "translate", "rotate", "scale") with these
    numbers.
    """
    motion = np.eye(4)
    if kind == "matrix":
        return numbers.reshape(4, 4)
    if kind == "translate":
        motion[:3, 3] = numbers
    elif kind == "scale":
        motion[:3, :3] = np.diag(numbers)
    else:
        x, y, z = numbers[:3] / np.linalg.norm(numbers[:3])
        angle = math.radians(numbers[3])
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        motion[:3, :3] += math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    return motion
