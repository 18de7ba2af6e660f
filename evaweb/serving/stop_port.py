"""Port of the stop process, announced to the web by a file, because either may start first or restart."""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

from django.conf import settings
from django.http import HttpRequest

from evaweb.serving.origins import origin_at_port
from runtime.recording.files import write_atomic


class StopPort(NamedTuple):
    """Port of the stop process, and the port of the web whose pages it serves."""

    port: int
    web_port: int

    def start(self) -> None:
        """Announce that the stop process is listening."""
        write_atomic(_path(), json.dumps(self._asdict()).encode())

    def end(self) -> None:
        """Withdraw the announcement."""
        remove_stop_port()


def remove_stop_port() -> None:
    """Delete the announcement: the stop process does not listen any more."""
    _path().unlink(missing_ok=True)


def read_stop_port() -> StopPort | None:
    """Return the announced ports, None if there is no valid announcement."""
    try:
        fields = json.loads(_path().read_bytes())
        return StopPort(int(fields["port"]), int(fields["web_port"]))
    except (OSError, ValueError, KeyError, TypeError):
        return None


def origin_for(request: HttpRequest) -> str:
    """Return the origin to which this page sends stops besides its own, "" if there is none.

    There is none for a page that came through a proxy or with EVA_HTTPS: it must not call plain HTTP.
    """
    stop_port = read_stop_port()
    if (
        stop_port is None
        or settings.SESSION_COOKIE_SECURE
        or request.META["SERVER_PORT"] != str(stop_port.web_port)
    ):
        return ""
    return origin_at_port(request.get_host(), stop_port.web_port, stop_port.port)


def _path() -> Path:
    return Path(settings.DATA_DIR) / "stops.json"
