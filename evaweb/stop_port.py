"""Ports of the process for stops: told to the web by a file, as either may be started first, or again."""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

from django.conf import settings
from django.http import HttpRequest

from evaweb.origins import origin_at_port
from runtime.recording.files import write_atomic


class StopPort(NamedTuple):
    """The port of the process for stops, and that of the web whose pages it answers."""

    port: int
    web_port: int

    def start(self) -> None:
        """It listens."""
        write_atomic(_path(), json.dumps(self._asdict()).encode())

    def end(self) -> None:
        """It ends."""
        remove_stop_port()


def remove_stop_port() -> None:
    """Nothing listens any more, and nothing will."""
    _path().unlink(missing_ok=True)


def read_stop_port() -> StopPort | None:
    """Ports of the process for stops, as it or its lab last said; None where there is none."""
    try:
        found = json.loads(_path().read_bytes())
        return StopPort(int(found["port"]), int(found["web_port"]))
    except (OSError, ValueError, KeyError, TypeError):
        return None


def origin_for(request: HttpRequest) -> str:
    """The origin at which the page that is asked for presses; "" where it has none beside its own.

    A page that came through a proxy has its own alone, and one of EVA_HTTPS: it must not call plain HTTP.
    """
    found = read_stop_port()
    if found is None or settings.SESSION_COOKIE_SECURE or request.META["SERVER_PORT"] != str(found.web_port):
        return ""
    return origin_at_port(request.get_host(), found.web_port, found.port)


def _path() -> Path:
    return Path(settings.DATA_DIR) / "stops.json"
