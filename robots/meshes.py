"""Mesh files: search for a robot's files, and their bounding boxes."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from urllib.parse import unquote

import numpy as np

from robots import collada
from robots.errors import RobotError
from robots.rotations import Float64

ENVIRONMENT = "EVA_ROBOT_MESHES"
SUFFIXES = (".stl", ".obj", ".dae")
Bounds = tuple[Float64, Float64]
_SPACE = r"[^\S\n]"  # blanks within a line
_CORNER = 3 * rf"{_SPACE}+(\S+)"


def mesh_roots(folder: Path) -> tuple[Path, ...]:
    """Return the folders that may contain meshes of the robot in `folder`: its own, and
    $EVA_ROBOT_MESHES/<its name>.
    """
    text = os.environ.get(ENVIRONMENT, "")
    if not text:
        return (folder.resolve(),)
    meshes = Path(text).expanduser()
    if not meshes.is_dir():
        raise RobotError(f"{ENVIRONMENT} = {text!r} is no folder; needed: one with a folder per robot")
    return folder.resolve(), (meshes / folder.name).resolve()


def resolve_mesh(folder: Path, owner: str, filename: str) -> Path:
    """Return the file that `filename` in a URDF in `folder` refers to: relative path, package://NAME/... or file://...

    It must be within one of the `mesh_roots` after resolving links. Errors begin with `owner`.

    Raises:
        RobotError: If it is missing or not allowed; the message lists the searched paths.
    """
    if Path(filename).suffix.lower() not in SUFFIXES:
        raise RobotError(f"{owner}: mesh {filename!r}; allowed: files {', '.join(SUFFIXES)}")
    allowed = mesh_roots(folder)
    try:
        places = [place for root in allowed for place in _places(root, owner, filename)]
        existing = [place for place in places if place.is_file()]
    except (OSError, ValueError) as error:  # name too long for the file system, or with a NUL character
        raise RobotError(f"{owner}: mesh {filename!r:.120} is no name of a file: {error!s:.80}") from error
    for place in places:
        if not any(place.is_relative_to(root) for root in allowed):
            raise RobotError(
                f"{owner}: mesh {filename!r} is {place}; allowed: files in {' or '.join(map(str, allowed))}"
            )
    for place in existing:
        return place
    raise RobotError(
        f"{owner}: mesh {filename!r} is missing; looked for {', '.join(map(str, dict.fromkeys(places)))}"
        f"; put it there, or under ${ENVIRONMENT}/{folder.name}"
    )


def replacement_mesh(folder: Path, link: str) -> Path | None:
    """Return the mesh that replaces the URDF's visuals of a link, None if there is none.

    It is $EVA_ROBOT_MESHES/<robot>/<link> with the suffix .stl, .obj or .dae.
    """
    for root in mesh_roots(folder)[1:]:
        for suffix in SUFFIXES:
            place = (root / f"{link}{suffix}").resolve()
            if place.is_file() and place.is_relative_to(root):
                return place
    return None


def mesh_bounds(path: Path) -> Bounds:
    """Return the lower and upper corner [3] of the file's content, in its own axes [m].

    Raises:
        RobotError: If it cannot be read.
    """
    try:
        return _bounds(path, path.stat().st_mtime_ns)
    except (OSError, ValueError) as error:
        raise RobotError(f"{path}: cannot be read as a mesh: {error}") from error


def _places(root: Path, owner: str, filename: str) -> Iterator[Path]:
    """Yield the paths in `root` at which the mesh file `filename` of a URDF may be.

    A path of the form package://NAME/... is searched in the folder NAME of `root`, and in `root` itself. `owner` names
    the robot in errors.
    """
    scheme, separator, path = filename.partition("://")
    if not separator:
        yield (root / filename).resolve()
    elif scheme == "file":
        yield Path(unquote(path)).resolve()
    elif scheme == "package":
        _, _, inside = path.partition("/")
        yield (root / path).resolve()
        yield (root / inside).resolve()
    else:
        raise RobotError(f"{owner}: mesh {filename!r}; allowed: a path, package://... or file://...")


@lru_cache(maxsize=512)
def _bounds(path: Path, _changed: int) -> Bounds:
    suffix = path.suffix.lower()
    if suffix == ".dae":
        points = collada.read_points(path)
    else:
        points = _stl(path.read_bytes()) if suffix == ".stl" else _obj(path.read_text(errors="replace"))
    if points.size == 0 or not np.isfinite(points).all():
        raise ValueError("no points, or some that are not finite")
    corners = points.min(axis=0), points.max(axis=0)
    for corner in corners:
        corner.setflags(write=False)
    return corners


def _stl(content: bytes) -> Float64:
    """Return the corners [n, 3] of an STL's triangles; it is read as binary if its length fits that, else as text."""
    count = int.from_bytes(content[80:84], "little")
    if len(content) >= 84 and len(content) == 84 + 50 * count:
        triangle = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
        return np.frombuffer(content, triangle, count, 84)["corners"].reshape(-1, 3).astype(np.float64)
    if not content.lstrip().startswith(b"solid"):
        raise ValueError("neither a binary STL of the length that it says nor a text one")
    vertices = re.findall(rf"^{_SPACE}*vertex{_CORNER}", content.decode(errors="replace"), re.MULTILINE)
    return np.array(vertices, dtype=np.float64).reshape(-1, 3)


def _obj(text: str) -> Float64:
    """Return the vertices [n, 3] of an OBJ file."""
    vertices = re.findall(rf"^{_SPACE}*v{_CORNER}", text, re.MULTILINE)
    return np.array(vertices, dtype=np.float64).reshape(-1, 3)
