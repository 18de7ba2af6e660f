"""Lockstep station with the sockets of an ordinary station: commands, streams, pictures, e-stop.

Time passes as fast as the machine can while it sets up or the policy drives. It is paused while the station is ready,
while the policy computes and while an episode is being closed, so that no recording depends on the duration of these.
A paced station runs in real time in every state, as people expect, and is paused only while the policy computes and
while an episode is being closed. Leases and the validity of commands use real time, which is never paused.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import zmq

from runtime.core import process_limits as descriptors
from runtime.core.clock import Clock, MonotonicClock, VirtualClock
from runtime.core.errors import SetupError
from runtime.core.realtime import LOCKSTEP
from runtime.ipc.bus import Endpoints, Key
from runtime.ipc.session_state import SessionState
from runtime.processes.control.process import Lateness
from runtime.processes.coordinator.inference.runners import DeclaredRunner
from runtime.processes.coordinator.process import CommandService
from runtime.processes.guard.process import EStopServer
from runtime.processes.lockstep.lockstep import Lockstep, LockstepEnvironment, Over, Peers
from runtime.processes.media.crash_repair import start_repair
from runtime.processes.media.export_jobs import ExportQueue
from runtime.processes.media.previews import Previews
from runtime.processes.media.unclosed_episodes import in_background
from runtime.station.lock import acquire_station_lock
from runtime.station.spec import StationSpec

_POLL_S = 0.002  # polling period for commands while time is paused [s]
_AGAIN_S = 0.2  # period for showing the same pictures again [s]
_LAST_S, _EXPORT_S = 8.0, 3.0  # time at the end for the last episode and for exports [s]
_FIGURES_EVERY = 30  # [ticks]
_ON_DEMAND = ("step", "preview", "manual")  # modes that wait for a person, in real time


class _TickingClock(Clock):
    """Clock of the station's guard: while the guard waits until some time, this clock runs ticks until that time."""

    def __init__(self, clock: Clock, tick: Callable[[], None]) -> None:
        self._clock, self._tick = clock, tick

    def now(self) -> float:
        return self._clock.now()

    def sleep_until(self, deadline: float) -> None:
        while self._clock.now() < deadline:
            self._tick()


class ServedLockstep(Lockstep):
    """Lockstep station with sockets; call `serve`, then `close`.

    Raises SetupError if another process has locked the station, or if the deployment needs something that lockstep
    lacks.
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
        descriptors.raise_file_limit()
        self._lock = acquire_station_lock(settings)
        Endpoints(settings.station_dir).prepare()
        Key(settings.station_dir).secret()
        self._exports = ExportQueue(settings.data, settings.recording.export)
        start_repair(settings.episodes_dir, settings.station, self._exports.submit)
        self._previews = Previews(spec)
        self._asking = DeclaredRunner(self.delayed, least=0 if settings.lockstep.benchmark else 1)
        self._observed = False  # benchmark mode: a control period waits for the policy, between its two parts
        around = LockstepEnvironment(
            runner=self._asking,
            client_clock=self._people,
            waits=_TickingClock(clock, self._tick_ahead),
            preview=self._previews,
            closer=in_background,
            on_disk=self._exports.submit,
            over=over,
        )
        super().__init__(spec, clock, around, peers)
        self._figures = Lateness(self._tick.status, LOCKSTEP)
        context: zmq.Context[Any] = zmq.Context.instance()
        self._estops = EStopServer(self.guard, self.shared, context, settings.station_dir)
        self._service = CommandService(self.coordinator, context)
        self._told_at = -1  # step of the last report to the coordinator while time was paused
        self._again_at = self._next_at = 0.0  # on the clients' clock [s]

    def serve(self, ended: Callable[[], bool]) -> None:
        """Tick while time is not paused, answer commands and publish, until `ended` returns True."""
        self.connect()
        while not ended():
            self.poll()

    def poll(self) -> None:
        """Run one tick if time is not paused, then handle all waiting commands."""
        wait = _POLL_S
        if not self._is_paused():
            now = self._people.now()
            if self._observed:
                self._finish_tick()
            elif self._is_unpaced():
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
        """Run one control period; in benchmark mode only up to the request, if its policy is still computing."""
        if not self._observed:
            super()._advance_clock()
            self._observe()
            self._observed = self._benchmark and self._asking.busy
            if self._observed and self._asking.start_waiting():
                return  # a policy that has answered already needs no wait
        self._finish_tick()

    def _finish_tick(self) -> None:
        if self._observed:
            self._observed = False
            self.coordinator.poll()  # the response is for this period
        self._act()
        self._figures.add(0.0, 0)
        if self.step % _FIGURES_EVERY == 0:
            self._figures.write()

    def _tick_ahead(self) -> None:
        """Run a tick early because an e-stop press waits.

        Later ticks are delayed by one period, because otherwise time would run faster than real time.
        """
        self._next_at = max(self._next_at, self._people.now()) + 1.0 / self.spec.rate
        self.tick()
        if self._observed:  # a stop does not wait for the policy
            self._finish_tick()

    def _advance_clock(self) -> None:
        """Do nothing: time advances at the start of a tick, since the policy is queried between ticks."""

    def _is_paused(self) -> bool:
        """Return True if virtual time is paused.

        Time is paused while the station waits for the policy or for the end of a closing episode. It is also paused
        while nothing needs time: the session is idle or ready, no generated motion or recording is in progress, and
        control has no orders to read. A station that is paced by real time is not paused for this second reason.
        """
        if self._asking.start_waiting() or self.media.closing:
            return True
        if (
            self._paced
            or self._observed
            or self.coordinator.session.state not in (SessionState.IDLE, SessionState.READY)
        ):
            return False
        moving = bytes(self.shared.control.read()["behaviour"]) == b"motion"
        return not (
            moving or self.coordinator.runs.is_recording_standalone or self.shared.rings["orders"].waiting
        )

    def _is_unpaced(self) -> bool:
        """Return True if ticks may follow each other as fast as possible.

        That is so if no operator watches them in real time.
        """
        if self._paced:
            return False
        state, run = self.coordinator.session.state, self.coordinator.run
        if state is SessionState.RUNNING:
            return run is None or run.mode not in _ON_DEMAND
        return state is SessionState.SETTING_UP

    def _poll_paused(self) -> None:
        """Handle messages while time is paused; whatever they begin starts with the next tick."""
        self.guard.poll()
        closing, rests = (
            self.media.closing,
            self.coordinator.session.state in (SessionState.IDLE, SessionState.READY),
        )
        if closing:
            self.media.report_closed()
        elif rests:
            self.media.poll()
        # Report once per pause, and after the episode is closed, so that the next command finds it reported.
        if not self.media.closing and (closing or (rests and self._told_at != self.step)):
            self._told_at = self.step
            self.media.report()
            self.reception.report()
        self.coordinator.poll()
        if (now := self._people.now()) >= self._again_at:
            self._again_at = now + _AGAIN_S
            self._previews.republish()

    def close(self) -> None:
        """Close the episode, pending requests and all sockets; then another process may use the station."""
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
