"""The lab that is attacked, and when an attack begins and ends."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from evaweb.lab.visitor import RestClient


@dataclass(frozen=True, slots=True)
class Target:
    """A lab of `benchmarks.estop_lab`; `share` of the whole attack, so that a test can make a short one."""

    url: str
    stops: str  # address of its process for stops
    passwords: Mapping[str, str]
    data: Path
    database: Path | None  # folder of a PostgreSQL server; None: the SQLite file in `data`
    share: float
    begun: Callable[[], None]  # to be called once it is under way
    ended: threading.Event

    @property
    def address(self) -> tuple[str, int]:
        """Host and port of the web."""
        found = urlsplit(self.url)
        return found.hostname or "", found.port or 80

    def part(self, whole: int) -> int:
        """The share of a number, at least 1."""
        return max(1, round(self.share * whole))

    def visitor(self, username: str) -> RestClient:
        """Somebody who has logged in."""
        found = RestClient(self.url)
        found.login(username, self.passwords[username])
        return found
