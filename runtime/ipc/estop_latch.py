"""E-stop latch on disk: survives all processes, and is read before the first command after a restart."""

from __future__ import annotations

import json
import os
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from runtime.core.durable_files import sync_folder


@dataclass(frozen=True, slots=True)
class Latched:
    """Latched press of the e-stop: user, reason, and Unix time [s]."""

    by: str
    why: str
    wall: float


class Latch:
    """File whose existence means that the e-stop is latched."""

    def __init__(self, station_dir: Path) -> None:
        self._path = station_dir / "estop.json"

    def read(self) -> Latched | None:
        """Return the latched press, None if not latched; an unreadable file counts as latched."""
        try:
            return Latched(**json.loads(self._path.read_text("utf-8")))
        except FileNotFoundError:
            return None
        except (OSError, ValueError, TypeError) as error:
            return Latched("unknown", f"the latch file cannot be read ({error})", 0.0)

    def set(self, by: str, why: str) -> Latched:
        """Write and sync the latch."""
        latched = Latched(by, why, time.time())
        self._path.parent.mkdir(parents=True, exist_ok=True)
        with self._path.open("w", encoding="utf-8") as file:
            json.dump(asdict(latched), file)
            file.flush()
            os.fsync(file.fileno())
        sync_folder(self._path.parent)
        return latched

    def clear(self) -> None:
        """Remove the latch."""
        self._path.unlink(missing_ok=True)
        sync_folder(self._path.parent)
