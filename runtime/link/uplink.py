"""State of the link as a station's own computer knows it: a file in the station's folder, for its panel."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from runtime.core.errors import TransportError
from runtime.ipc.bus import Endpoints

UPLINK = "uplink"
_NOT_RUNNING = "the process of the link does not run"


@dataclass(frozen=True, slots=True)
class Uplink:
    """State of the link: name of the lab, and if the link is down, since when and why.

    `since` is the Unix time [s] at which it went down, 0 while it is up; `why` is then "".
    """

    lab: str
    since: float = 0.0
    why: str = ""


class Telling:
    """Writer of the link's state to the station's folder."""

    def __init__(self, endpoints: Endpoints, lab: str, clock: Callable[[], float] = time.time) -> None:
        self._endpoints, self._clock = endpoints, clock
        self._said: Uplink | None = None
        self._lab = lab

    def update(self, trouble: str) -> None:
        """Write the state if it has changed or its file is missing.

        `trouble` is the reason why the link is down, "" if it is up.
        """
        before = self._said
        lost = before is not None and before.why
        since = 0.0 if not trouble else before.since if lost and before else self._clock()
        now = Uplink(self._lab, since, trouble)
        if now != before or self._endpoints.is_missing(UPLINK):
            self._said = now
            self._endpoints.write(UPLINK, {"lab": now.lab, "since": repr(now.since), "why": now.why})

    def end(self) -> None:
        """Remove the file: the state is unknown from now on."""
        self._endpoints.withdraw(UPLINK)


def read_uplink(endpoints: Endpoints) -> dict[str, Any] | None:
    """Return the state of the link as a dict for JSON; None if the station has no link to a lab.

    The keys are those of `Uplink`: "lab", "since" and "why".
    """
    try:
        endpoint = endpoints.read(UPLINK)
        fields = {"lab": str(endpoint["lab"]), "since": float(endpoint["since"]), "why": str(endpoint["why"])}
    except (TransportError, KeyError, ValueError, TypeError):
        return None
    return fields if endpoints.served(UPLINK) else fields | {"why": _NOT_RUNNING}
