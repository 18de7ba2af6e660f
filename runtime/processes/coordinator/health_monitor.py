"""Events that the coordinator notices by itself: siblings, e-stop, lease, link, the end of a run."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from runtime.cameras.complaints import complaints
from runtime.core.clock import Clock
from runtime.ipc.estop_latch import Latch
from runtime.ipc.messages import ReceptionReport
from runtime.ipc.session_state import SessionState
from runtime.ipc.shared_state import EStop, SharedState
from runtime.processes.coordinator.lease import Lease
from runtime.processes.coordinator.session.transitions import SessionEvent
from runtime.station.run import Run
from runtime.station.spec import StationSpec

SIBLINGS = ("control", "reception", "media", "guard")
_LINK_LOST_S = 2.0
_CONNECTED_S = 1.0
_EARLY_S = 1e-6  # moments are sums of floats
_LATCH_S = 0.2  # how long the e-stop's flag may be ahead of its latch on the disk


class Noticed(NamedTuple):
    """Something for the session, and the sentence that goes with it."""

    happening: SessionEvent
    reason: str
    process: str = ""  # that was restarted


class HealthMonitor:
    """Looks at page, lease and run once per pump; the session decides what follows."""

    def __init__(
        self,
        spec: StationSpec,
        shared: SharedState,
        lease: Lease,
        clock: Clock,
        people: Clock,
        reception: Callable[[], ReceptionReport],
    ) -> None:
        self._plan = spec
        self._page = shared
        self._lease = lease
        self._clock = clock
        self._people = people  # the clock of leases
        self._reception = reception  # what it last reported
        self._latch = Latch(spec.deployment.station_dir)
        self._generations = {name: shared.generation(name) for name in SIBLINGS}
        self._lease_held = False
        self.estop = ""  # who pressed and why, while it is latched
        self._pressed: float | None = None  # when the flag was seen without its latch

    def notice(self, state: SessionState, run: Run | None) -> Iterator[Noticed]:
        """News for the session, which is in `state` before the first of it."""
        yield from self._family(state)
        yield from self._estop(state)
        yield from self._leases()
        yield from self._link()
        if run is not None and run.begun is not None and state is SessionState.RUNNING:
            yield from self._end_of(run)

    def absent(self) -> str:
        """A sibling that gives no sign of life, "" where all do: what it is sent would be lost."""
        now, within = self._clock.now(), self._plan.deployment.heartbeat_timeout_s
        return next((name for name in SIBLINGS if not self._page.alive(name, now, within(name))), "")

    def missing_cameras(self) -> list[str]:
        """Cameras that have not sent a picture yet."""
        numbers = self._page.observation.read()["picture_number"]
        return [
            camera for camera, number in zip(self._page.layout.cameras, numbers, strict=False) if not number
        ]

    def _family(self, state: SessionState) -> Iterator[Noticed]:
        for name in SIBLINGS:
            generation = self._page.generation(name)
            if generation != self._generations[name]:
                self._generations[name] = generation
                reason = f"the process {name} died and was restarted: set up again"
                yield Noticed(SessionEvent.FAMILY_DIED, reason, name)
        absent = self.absent() if state is SessionState.RUNNING else ""  # a set-up looks for itself
        if absent:
            silent = self._page.silence(absent, self._clock.now())
            yield Noticed(SessionEvent.HELD, f"no sign of life from the process {absent} {silent}")

    def _estop(self, state: SessionState) -> Iterator[Noticed]:
        latched = self._page.estop is EStop.LATCHED
        if latched and state is not SessionState.FAULTED:
            pressed = self._latch.read()
            if not (pressed and pressed.wall) and self._just_pressed():  # absent, or half written
                return
            self.estop = f"by {pressed.by}: {pressed.why}" if pressed else "pressed"
            yield Noticed(SessionEvent.ESTOPPED, f"e-stop {self.estop}: make safe, then release")
        elif not latched and state is SessionState.FAULTED:
            self.estop, self._pressed = "", None
            yield Noticed(SessionEvent.RELEASED, "e-stop released: set up again")

    def _just_pressed(self) -> bool:
        """Control obeys the flag already; who pressed and why is on the disk a moment later."""
        now = self._clock.now()
        self._pressed = now if self._pressed is None else self._pressed
        return now - self._pressed < _LATCH_S

    def _leases(self) -> Iterator[Noticed]:
        held = self._lease.current(self._people.now()) is not None
        if self._lease_held and not held:
            yield Noticed(
                SessionEvent.LEASE_ENDED, "the lease was not renewed: claim it, then resume or stop"
            )
        self._lease_held = held

    def _link(self) -> Iterator[Noticed]:
        record = self._page.observation.read()
        if not record["sequence"]:
            return
        age = self._clock.now() - float(record["arrived"])
        missing = self.missing_cameras()
        if age < _CONNECTED_S and not missing:
            yield Noticed(SessionEvent.CONNECTED, "observations arrive: set up")
        elif age < _CONNECTED_S:
            why = "".join(f"; {sentence}" for sentence in complaints(self._reception().cameras, missing))
            yield Noticed(SessionEvent.INCOMPLETE, f"no picture has arrived from {', '.join(missing)}{why}")
        elif age > _LINK_LOST_S and not record["last"]:
            yield Noticed(SessionEvent.LINK_LOST, f"no observation for {age:.1f} s: {self._who_is_silent()}")

    def _who_is_silent(self) -> str:
        now, within = self._clock.now(), self._plan.deployment.control.heartbeat_timeout_s
        if self._page.alive("reception", now, within):
            return "is the execution node running?"
        return "our process reception gives no sign of life"

    def _end_of(self, run: Run) -> Iterator[Noticed]:
        limit = run.duration_s
        if limit is not None and run.elapsed(self._clock.now()) >= limit - _EARLY_S:
            yield Noticed(SessionEvent.RUN_ENDED, f"the run's {limit:g} s are over")
            return
        record: np.void = self._page.observation.read()
        if record["last"] and int(self._page.control.read()["sequence"]) == int(record["sequence"]):
            yield Noticed(SessionEvent.RUN_ENDED, "the recording that is the source has ended")
