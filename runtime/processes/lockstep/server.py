"""A lockstep station that people and programs find as they find any other: commands, streams, pictures, e-stop.

Its time passes as fast as the machine can while it sets up or the policy drives, and stands still while it is ready,
while the policy is asked and while an episode is being closed: nothing that is recorded depends on how long those
took. A paced one is no faster than life in any state, as people expect it, and only stands still while the policy is
asked and while an episode is being closed. Leases, and for how long a command is valid, are of the people's own time,
which goes on.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import zmq

from runtime.core import file_limits as descriptors
from runtime.core.clock import Clock, MonotonicClock, VirtualClock
from runtime.core.errors import PolicyError, SetupError
from runtime.core.realtime import LOCKSTEP
from runtime.ipc.bus import Endpoints, Key
from runtime.ipc.session_state import SessionState
from runtime.processes.control.process import Lateness
from runtime.processes.coordinator.inference.requests import PolicyResponse
from runtime.processes.coordinator.inference.worker import DeclaredRunner
from runtime.processes.coordinator.process import CommandService
from runtime.processes.guard.process import EStopServer
from runtime.processes.lockstep.lockstep import Lockstep, LockstepEnvironment, Peers
from runtime.processes.media.crash_repair import start_repair
from runtime.processes.media.episode_closing import in_background
from runtime.processes.media.export_jobs import ExportQueue
from runtime.processes.media.previews import Previews
from runtime.station.lock import acquire_station_lock
from runtime.station.spec import StationSpec

log = logging.getLogger(__name__)
_POLL_S = 0.002  # for a command, while time stands still
_AGAIN_S = 0.2  # between two showings of the same pictures
_LAST_S, _EXPORT_S = 8.0, 3.0  # at the end: for the last episode, for exports
_FIGURES_EVERY = 30  # ticks
_ON_DEMAND = ("step", "preview", "manual")  # modes in which a person is waited for: no faster than they live
Over = Callable[[bool], str]
"""Asked before each tick with whether a run goes on: why it is over, "" while it is not."""


def declared_delay(rate: float) -> Callable[[Any], tuple[Any, int]]:
    """Hand-over of a policy's answer, and how many ticks late it is: as late as it says that it took.

    A result that is no answer, that of connecting, is there with the next tick.
    """

    def told(result: Any) -> tuple[Any, int]:
        if not isinstance(result, PolicyResponse):
            return result, 1
        ms = result.chunk.timing.get("policy.infer_ms", 0.0)
        if not 0.0 <= ms < math.inf:
            raise PolicyError(
                f"the answer's policy_timing.infer_ms is {ms}: lockstep goes by it; allowed: 0 or more"
            )
        return replace(result, seconds=ms / 1e3), math.ceil(ms / 1e3 * rate - 1e-6)

    return told


class _TickingClock(Clock):
    """The station's clock for its guard, which waits for control: to wait is to tick."""

    def __init__(self, clock: Clock, tick: Callable[[], None]) -> None:
        self._clock, self._tick = clock, tick

    def now(self) -> float:
        return self._clock.now()

    def sleep_until(self, deadline: float) -> None:
        while self._clock.now() < deadline:
            self._tick()


class ServedLockstep(Lockstep):
    """One lockstep station with the sockets of a family; `serve` until told to end, then `close`.

    Raises SetupError where another process has the station, or what it needs is no part of lockstep.
    """

    def __init__(
        self,
        spec: StationSpec,
        clock: VirtualClock,
        over: Over = lambda running: "",
        people: Clock | None = None,
        peers: Peers | None = None,
        paced: bool = False,
    ) -> None:
        settings = spec.deployment
        self._paced = paced
        if settings.control_channel.enabled:
            raise SetupError("control_channel.enabled = true in lockstep, which has none; allowed: false")
        self._people = people or MonotonicClock()
        self._over = over
        descriptors.raise_file_limit()
        self._lock = acquire_station_lock(settings)
        Endpoints(settings.station_dir).prepare()
        Key(settings.station_dir).secret()
        self._exports = ExportQueue(settings.data, settings.recording.export)
        start_repair(settings.episodes_dir, settings.station, self._exports.submit)
        self._previews = Previews(spec)
        self._asking = DeclaredRunner(declared_delay(spec.rate))
        around = LockstepEnvironment(
            runner=self._asking,
            client_clock=self._people,
            waits=_TickingClock(clock, self._tick_ahead),
            preview=self._previews,
            closer=in_background,
            on_disk=self._exports.submit,
        )
        super().__init__(spec, clock, around, peers)
        self._figures = Lateness(self._tick.status, LOCKSTEP)
        context: zmq.Context[Any] = zmq.Context.instance()
        self._estops = EStopServer(self.guard, self.shared, context, settings.station_dir)
        self._service = CommandService(self.coordinator, context)
        self._told_at = -1  # the step that the coordinator was last told of how it goes, time standing still
        self._again_at = self._next_at = 0.0  # on the people's clock

    def serve(self, ended: Callable[[], bool]) -> None:
        """Tick where time passes, answer commands, publish, until `ended`."""
        self.connect()
        while not ended():
            self.poll()

    def poll(self) -> None:
        """One tick if time passes, then every command there is."""
        wait = _POLL_S
        if not self._is_paused():
            now = self._people.now()
            if self._is_unpaced():
                wait = 0.0
                self.tick()
            elif now >= self._next_at:
                self._next_at = now + 1.0 / self.spec.rate
                self.tick()
        else:
            self._poll_paused()
        self._service.serve(wait)
        self._estops.serve(0.0)

    def tick(self) -> None:
        """One control period; a run that is over ends within it."""
        super()._advance_clock()
        if why := self._over(self.coordinator.session.state is SessionState.RUNNING):
            self.coordinator.end_source_run(why)
        super().tick()
        self._figures.add(0.0, 0)
        if self.step % _FIGURES_EVERY == 0:
            self._figures.write()

    def _tick_ahead(self) -> None:
        """A tick that a press of the e-stop waits for: those after it come so much later, or it would hurry time."""
        self._next_at = max(self._next_at, self._people.now()) + 1.0 / self.spec.rate
        self.tick()

    def _advance_clock(self) -> None:
        """Time comes to a tick when that begins: the policy is asked between two, and it is now until it answers."""

    def _is_paused(self) -> bool:
        """True if time stands still: nothing needs it, or the policy or a closing episode is waited for."""
        if self._asking.start_waiting() or self.media.closing:
            return True
        if self._paced or self.coordinator.session.state not in (SessionState.IDLE, SessionState.READY):
            return False
        moving = bytes(self.shared.control.read()["behaviour"]) == b"motion"
        return not (
            moving or self.coordinator.runs.is_recording_standalone or self.shared.rings["orders"].waiting
        )

    def _is_unpaced(self) -> bool:
        """True if ticks need no pace: no operator is waited for, to see them as they happen."""
        if self._paced:
            return False
        state, run = self.coordinator.session.state, self.coordinator.run
        if state is SessionState.RUNNING:
            return run is None or run.mode not in _ON_DEMAND
        return state is SessionState.SETTING_UP

    def _poll_paused(self) -> None:
        """Hear and tell, while it is still now; what begins, begins with a tick."""
        self.guard.poll()
        closing, rests = (
            self.media.closing,
            self.coordinator.session.state in (SessionState.IDLE, SessionState.READY),
        )
        if closing:
            self.media.report_closed()
        elif rests:
            self.media.poll()
        # Once in each rest, and after the episode is closed: whoever commands next, however soon, finds it said.
        if not self.media.closing and (closing or (rests and self._told_at != self.step)):
            self._told_at = self.step
            self.media.report()
            self.reception.report()
        self.coordinator.poll()
        if (now := self._people.now()) >= self._again_at:
            self._again_at = now + _AGAIN_S
            self._previews.republish()

    def close(self) -> None:
        """Close the episode, what is asked, all sockets; then the station is free for another process."""
        self.media.poll()
        self.media.end("interrupted", "the station's supervisor ended")
        self.media.finish(_LAST_S)
        self._exports.finish(_EXPORT_S)
        super().close()
        self._service.close()
        self._estops.close()
        self._previews.close()
        Endpoints(self.spec.deployment.station_dir).clear()
        self._lock.close()
