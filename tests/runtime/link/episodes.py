"""Folders of closed episodes as a recorder leaves them, as far as the link looks into them."""

from __future__ import annotations

import json
import random
from pathlib import Path
from uuid import UUID

FILES = {"events.jsonl": 900, "front.mp4": 200_000, "ticks.arrow": 70_000, "empty.arrow": 0}


def uuid_of(seed: int) -> str:
    """A uuid, the same for the same number."""
    return str(UUID(int=random.Random(seed).getrandbits(128), version=4))


def recorded(data: Path, station: str, seed: int = 1, closed: bool = True, uuid: str = "") -> Path:
    """An episode of that station in `data`."""
    noise, uuid = random.Random(seed), uuid or uuid_of(seed)
    folder = data / "episodes" / uuid
    folder.mkdir(parents=True)
    (folder / "manifest.json").write_text(json.dumps({"uuid": uuid, "station": station}))
    for name, size in FILES.items():
        (folder / name).write_bytes(noise.randbytes(size))
    if closed:
        (folder / "outcome.json").write_text(json.dumps({"status": "finished"}))
    return folder


def content(folder: Path) -> dict[str, bytes]:
    """Every file of a folder, by its name."""
    return {path.name: path.read_bytes() for path in folder.iterdir()}
