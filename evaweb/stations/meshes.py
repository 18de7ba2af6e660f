"""The files with meshes that a robot is drawn with, known to pages by their content alone, never by a path."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from hashlib import sha256
from pathlib import Path

from evaweb.errors import NotFound
from evaweb.stations.robot_geometry import looks_of


@dataclass(frozen=True, slots=True)
class Mesh:
    """A file's content: its sha256 in hex, and whether it is "stl", "obj" or "dae"."""

    digest: str
    format: str


def mesh_in(file: Path) -> Mesh:
    """Mesh in the file as it is now; NotFound where it cannot be read."""
    return Mesh(_digest(file), file.suffix.lower().removeprefix("."))


def mesh_content(*, robot: str, digest: str) -> bytes:
    """The content of that digest; NotFound unless one of the robot's visuals shows a file that has it."""
    files = {visual.file for visual in looks_of(robot).scene.visuals if visual.file is not None}
    for file in sorted(files):
        if _digest(file) == digest:
            content = file.read_bytes()
            if sha256(content).hexdigest() == digest:
                return content
    raise NotFound(f"{robot} shows no mesh {digest!r:.80}: load the page again")


def _digest(file: Path) -> str:
    try:
        stat = file.stat()
        return _digest_of(file, stat.st_mtime_ns, stat.st_size)
    except OSError as error:
        raise NotFound(f"the mesh {file.name} cannot be read: {error.strerror}") from None


@lru_cache(1024)
def _digest_of(file: Path, _changed: int, _size: int) -> str:
    return sha256(file.read_bytes()).hexdigest()
