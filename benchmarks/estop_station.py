"""Station whose e-stop is pressed: its run, its releases, responsiveness of the coordinator, and memory growth."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, NamedTuple

import psutil

from benchmarks.estop_lab import PRESSED
from runtime.clients.client import RENEW_S, StationClient
from runtime.core.errors import RuntimeFault
from runtime.ipc.bus import Endpoints
from runtime.ipc.estop_latch import Latch

_STATE_S = 0.1  # between two snapshots
_READY_S, _RELEASE_S = 120.0, 2.0
_TRIES = 3
_HOLDER = "benchmark"
_FAMILY = ("coordinator", "guard")


class Station:
    """Station that is commanded directly, without the web."""

    def __init__(self, data: Path) -> None:
        self._folder = data / "stations" / PRESSED
        self.client = self.another_client()
        self._newest_event = 0

    def another_client(self) -> StationClient:
        """Return another client with the same lease, for use in a thread."""
        return StationClient(self._folder, _HOLDER)

    @property
    def latched(self) -> bool:
        """Whether the e-stop is latched on disk."""
        return Latch(self._folder).read() is not None

    def pids(self) -> list[int]:
        """Return the process ids of coordinator and guard."""
        endpoints = Endpoints(self._folder).read("supervisor")
        return [int(endpoints[name]) for name in _FAMILY]

    def wait_until_up(self) -> Mapping[str, Any]:
        """Return the status as soon as the station answers.

        Raises:
            RuntimeFault: If it does not answer in time.
        """
        until = time.monotonic() + _READY_S
        while True:
            try:
                return self.client.status()
            except RuntimeFault:
                if time.monotonic() > until:
                    raise
                time.sleep(0.1)

    def run(self) -> None:
        """Set up and begin a run without end; if the machine was late, try again."""
        reason = ""
        for _ in range(_TRIES):
            try:
                status = self._tried()
            except RuntimeFault as fault:
                reason = str(fault)
                continue
            if status["state_is"]["going"]:
                self._newest_event = status["newest_event"]
                return
            reason = status["reason"]
        raise SystemExit(f"{PRESSED} does not run: {reason}")

    def _tried(self) -> Mapping[str, Any]:
        """Try to set up and run; return the state one second after the start of the run, or the state reached
        instead.
        """
        state_is = self.wait_until_up()["state_is"]
        if state_is["latched"]:
            self.release()
        elif state_is["held"]:
            self.client.command("stop")
        self.client.wait(lambda found: found["state_is"]["idle"] or found["state_is"]["ready"], _READY_S)
        self.client.command("setup")
        status = self.client.wait(lambda found: not found["state_is"]["preparing"], _READY_S)
        if not status["state_is"]["ready"]:
            return status
        self.client.command("run")
        return self.client.wait(
            lambda found: found["run"]["elapsed"] > 1.0 or not found["state_is"]["going"], _READY_S
        )

    def release(self) -> bool:
        """Release the e-stop; return False if the station does not latch the press or does not release the latch in
        time.
        """
        try:
            self.client.wait(lambda status: status["state_is"]["latched"], _RELEASE_S)
            self.client.command("release")
            self.client.wait(lambda status: not status["state_is"]["latched"], _RELEASE_S)
        except RuntimeFault:
            return False
        return True

    def interruption(self) -> str:
        """Return the event that ended the run before the press, "" if the run was not interrupted.

        Raises:
            RuntimeFault: If the station does not answer.
        """
        self.wait_until_up()
        events = self.client.events_since(self._newest_event)
        left = [event["text"] for event in events if event["kind"] in ("state", "family_died")]
        return "" if not left or "e-stop" in left[0] else left[0]

    def close(self) -> None:
        self.client.close()


class AttackLoad(NamedTuple):
    """Measurements of web and station during an attack: snapshots and memory."""

    main_late_ms: float  # longest delay of a snapshot
    web_growth_mb: float
    station_growth_mb: float


class StationWatch:
    """Observer of the coordinator's snapshots and of memory, which also renews the lease, until `end`."""

    def __init__(self, station: Station, web: int) -> None:
        self._heard = [time.monotonic()]
        self._ended = threading.Event()
        self._web, self._family = [web], station.pids()
        self._before = _memory(self._web), _memory(self._family)
        self._most = self._before
        self._threads = [
            threading.Thread(target=work, args=arguments, daemon=True)
            for work, arguments in (
                (self._listen, (station.client,)),
                (self._claim, (station.another_client(),)),
                (self._poll, ()),
            )
        ]
        for thread in self._threads:
            thread.start()

    def end(self) -> AttackLoad:
        """Stop observing and return the measurements."""
        self._ended.set()
        for thread in self._threads:
            thread.join()
        gaps = [b - a for a, b in zip(self._heard, [*self._heard[1:], time.monotonic()], strict=True)]
        web, family = ((most - before) / 1e6 for most, before in zip(self._most, self._before, strict=True))
        return AttackLoad(max(0.0, max(gaps) - _STATE_S) * 1000.0, web, family)

    def _listen(self, client: StationClient) -> None:
        with closing(client.subscribe("state")) as subscriber:
            while not self._ended.is_set():
                if subscriber.receive(0.05):
                    self._heard.append(time.monotonic())

    def _claim(self, client: StationClient) -> None:
        """Renew the lease like an open page.

        Errors are ignored, because the station's events show whether the run continues.
        """
        with closing(client):
            while not self._ended.wait(RENEW_S):
                with suppress(RuntimeFault):
                    client.claim()

    def _poll(self) -> None:
        while not self._ended.wait(0.1):
            web, family = _memory(self._web), _memory(self._family)
            self._most = max(self._most[0], web), max(self._most[1], family)


def _memory(pids: list[int]) -> float:
    """Return the memory of processes [bytes]; a process that has ended counts as 0."""
    total = 0.0
    for pid in pids:
        try:
            total += psutil.Process(pid).memory_info().rss
        except psutil.NoSuchProcess:
            continue
    return total
