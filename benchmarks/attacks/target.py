"""Target of an attack: the lab, with the signals for the attack's begin and end."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from evaweb.lab.rest_client import RestClient


@dataclass(frozen=True, slots=True)
class Target:
    """Lab of `benchmarks.estop_lab` as target; `share` scales the attack, so that tests can use a weak one."""

    url: str
    stops: str  # address of its process for stops
    passwords: Mapping[str, str]
    data: Path
    database: Path | None  # folder of a PostgreSQL server; None: the SQLite file in `data`
    share: float
    begun: Callable[[], None]  # to be called when the attack has begun
    ended: threading.Event

    @property
    def address(self) -> tuple[str, int]:
        """Host and port of the web."""
        address = urlsplit(self.url)
        return address.hostname or "", address.port or 80

    def part(self, whole: int) -> int:
        """Return `whole` multiplied by `share`, at least 1."""
        return max(1, round(self.share * whole))

    def visitor(self, username: str) -> RestClient:
        """Return a client that is logged in as that user."""
        client = RestClient(self.url)
        client.login(username, self.passwords[username])
        return client
