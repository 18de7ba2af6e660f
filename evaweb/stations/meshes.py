"""Mesh files of robots, which pages request by content digest, never by path."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from hashlib import sha256
from pathlib import Path

from evaweb.core.errors import NotFound
from evaweb.stations.robot_geometry import drawn_robot
from runtime.core.sentences import Pattern

_SHOWS_NO_MESH_LOAD_PAGE = Pattern(
    "stations.meshes.shows_no_mesh_load_page",
    "{robot} shows no mesh {digest!r:.80}: load the page again",
)
_MESH_CANNOT_READ = Pattern("stations.meshes.mesh_cannot_read", "the mesh {name} cannot be read: {strerror}")


@dataclass(frozen=True, slots=True)
class Mesh:
    """Content of a mesh file: its SHA-256 in hexadecimal, and its format "stl", "obj" or "dae"."""

    digest: str
    format: str


def mesh_in(file: Path) -> Mesh:
    """Return digest and format of the file as it is now. Raises: NotFound if it cannot be read."""
    return Mesh(_digest(file), file.suffix.lower().removeprefix("."))


def mesh_content(*, robot: str, digest: str) -> bytes:
    """Return the mesh with that digest. Raises: NotFound unless a visual of the robot uses a file with that digest."""
    files = {visual.file for visual in drawn_robot(robot).scene.visuals if visual.file is not None}
    for file in sorted(files):
        if _digest(file) == digest:
            content = file.read_bytes()
            if sha256(content).hexdigest() == digest:
                return content
    raise NotFound(_SHOWS_NO_MESH_LOAD_PAGE(robot=robot, digest=digest))


def _digest(file: Path) -> str:
    try:
        stat = file.stat()
        return _digest_of(file, stat.st_mtime_ns, stat.st_size)
    except OSError as error:
        raise NotFound(_MESH_CANNOT_READ(name=file.name, strerror=error.strerror)) from None


@lru_cache(1024)
def _digest_of(file: Path, _changed: int, _size: int) -> str:
    return sha256(file.read_bytes()).hexdigest()
