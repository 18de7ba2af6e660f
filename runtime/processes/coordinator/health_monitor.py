"""Health checks of the coordinator: sibling processes, e-stop, lease, link, end of the run."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from runtime.cameras.base import describe_camera_problems
from runtime.core.clock import Clock
from runtime.core.sentences import Pattern, fixed, series
from runtime.ipc.estop_latch import Latch
from runtime.ipc.messages import Event, ReceptionReport
from runtime.ipc.session_state import SessionState
from runtime.ipc.shared_state import EStop, SharedState
from runtime.processes.coordinator.lease import Lease
from runtime.processes.coordinator.session.transitions import SessionEvent
from runtime.station.run import Run
from runtime.station.spec import StationSpec

_RESTARTED = Pattern("health.restarted", "the process {process} died and was restarted: set up again")
_SILENT = Pattern("health.silent", "no sign of life from the process {process} {since}")
_RECORDING_LATE = Pattern(
    "health.recording_late",
    "the recorder has given no sign of life {since}: is the disk slow? The run goes on and is recorded once it is "
    "back; the robot is held when half of the room for that is taken, {percent:.0f} % is now",
)
_RECORDING_WAITS = Pattern(
    "health.recording_waits",
    "no sign of life from the process media {since}, and more than half of the room for what waits to be recorded is "
    "taken",
)
_RECORDING_GOES_ON = fixed("health.recording_goes_on", "the recorder goes on")
_ESTOPPED = Pattern("health.estopped", "e-stop {pressed}: make safe, then release")
_NO_PICTURE = Pattern("health.no_picture", "no picture has arrived from {cameras}")
_PRESSED_BY = Pattern("health.pressed_by", "by {who}: {why}")
_PRESSED = fixed("health.pressed", "pressed")
_RELEASED = fixed("health.released", "e-stop released: set up again")
_LEASE_ENDED = fixed("health.lease_ended", "the lease was not renewed: claim it, then resume or stop")
_GOES_ON = Pattern(
    "health.goes_on",
    "no operator: the lease was not renewed; the scored run continues to its {seconds:g} s, "
    "and a person beside the robot can stop it",
)
_PANEL_GONE = fixed(
    "health.panel_gone",
    "no operator: its panel ended as well; claim the lease, then resume or stop",
)
_CONNECTED = fixed("health.connected", "the robot is connected: press Set up")
_LINK_LOST = Pattern("health.link_lost", "no observation for {seconds:.1f} s: {who}")
_ASK_FOR_NODE = fixed("health.ask_for_node", "is the execution node running?")
_RECEPTION_SILENT = fixed("health.reception_silent", "our process reception does not answer")
_TIME_OVER = Pattern("health.time_over", "the run's {seconds:g} s are over")
_SOURCE_ENDED = fixed("health.source_ended", "the recording that is the source has ended")

SIBLING_PROCESSES = ("control", "reception", "media", "guard")
_TO_RECORD = ("minutes", "ticks", "observations")  # rings that media reads
_MOST_WAITING = 0.5  # share of a ring; when it is full, further messages are lost
_LINK_LOST_S = 2.0
_CONNECTED_S = 1.0
_EARLY_S = 1e-6  # rounding tolerance of summed times
_LATCH_S = 0.2  # [s] by which the e-stop flag may precede its latch on disk


class HealthEvent(NamedTuple):
    """Event for the session, with its reason."""

    happening: SessionEvent
    reason: str
    process: str = ""  # the restarted process


class HealthMonitor:
    """Monitor of shared state, lease and run; it yields events, and the session decides."""

    def __init__(
        self,
        spec: StationSpec,
        shared: SharedState,
        lease: Lease,
        clock: Clock,
        people: Clock,
        reception: Callable[[], ReceptionReport],
        stoppable: Callable[[], bool],
    ) -> None:
        """Begin to monitor.

        Args:
            spec: Specification of the station.
            shared: Shared state of the station's processes.
            lease: Lease to monitor.
            clock: Clock of the runtime.
            people: Clock of leases.
            reception: Returns the latest report of reception.
            stoppable: Returns True if a person at the robot can stop the run, because the station's panel is served.
        """
        self._plan = spec
        self._shared_state = shared
        self._lease = lease
        self._clock = clock
        self._people = people  # the clock of leases
        self._reception = reception  # its latest report
        self._stoppable = stoppable
        self._latch = Latch(spec.deployment.station_dir)
        self._generations = {name: shared.generation(name) for name in SIBLING_PROCESSES}
        self._lease_held = False
        self._unattended = False  # a run continues although its lease holder is lost
        self._recording_late = False
        self.estop = ""  # who pressed and why, while it is latched
        self._pressed: float | None = None  # when the flag was set without its latch

    def poll(self, state: SessionState, run: Run | None) -> Iterator[HealthEvent]:
        """Yield events for the session.

        `state` is the session's state before the first of these events, `run` the open run.
        """
        yield from self._check_heartbeats(state)
        yield from self._estop(state)
        yield from self._leases(run if state is SessionState.RUNNING else None)
        yield from self._link()
        if run is not None and run.begun_at is not None and state is SessionState.RUNNING:
            yield from self._end_of(run)

    def silent_sibling(self) -> str:
        """Return the name of a process with an expired heartbeat, "" if there is none.

        Messages to such a process would be lost.
        """
        return next((name for name in SIBLING_PROCESSES if not self._alive(name)), "")

    def _alive(self, name: str) -> bool:
        within = self._plan.deployment.heartbeat_timeout_s(name)
        return self._shared_state.alive(name, self._clock.now(), within)

    @property
    def _waiting_to_record(self) -> float:
        """Used share of the fullest ring to media, 0 to 1."""
        return max(self._shared_state.rings[ring].fill for ring in _TO_RECORD)

    def poll_recorder(self, state: SessionState) -> Iterator[Event]:
        """Yield events when the recorder's heartbeat expires during a run, and when it returns."""
        now, late = self._clock.now(), not self._alive("media")
        if late and not self._recording_late and state is SessionState.RUNNING:
            since, percent = (
                self._shared_state.describe_silence("media", now),
                100.0 * self._waiting_to_record,
            )
            yield Event("recording_late", _RECORDING_LATE(since=since, percent=percent), now)
            self._recording_late = True
        elif self._recording_late and not late:
            yield Event("recording_goes_on", _RECORDING_GOES_ON, now)
            self._recording_late = False

    def missing_cameras(self) -> list[str]:
        """Return the cameras that have not sent a picture yet."""
        numbers = self._shared_state.observation.read()["picture_number"]
        return [
            camera
            for camera, number in zip(self._shared_state.layout.cameras, numbers, strict=False)
            if not number
        ]

    def _check_heartbeats(self, state: SessionState) -> Iterator[HealthEvent]:
        for name in SIBLING_PROCESSES:
            generation = self._shared_state.generation(name)
            if generation != self._generations[name]:
                self._generations[name] = generation
                reason = _RESTARTED(process=name)
                yield HealthEvent(SessionEvent.FAMILY_DIED, reason, name)
        if state is not SessionState.RUNNING:  # a set-up checks this itself
            return
        now = self._clock.now()
        # Media moves nothing, and unread messages wait for it in the rings, unless it has ended.
        ended = not self._shared_state.last_beat("media")
        silent = [name for name in SIBLING_PROCESSES if not self._alive(name) and (name != "media" or ended)]
        if silent:
            yield HealthEvent(
                SessionEvent.HELD,
                _SILENT(process=silent[0], since=self._shared_state.describe_silence(silent[0], now)),
            )
        elif not self._alive("media") and self._waiting_to_record > _MOST_WAITING:
            yield HealthEvent(
                SessionEvent.HELD, _RECORDING_WAITS(since=self._shared_state.describe_silence("media", now))
            )

    def _estop(self, state: SessionState) -> Iterator[HealthEvent]:
        latched = self._shared_state.estop is EStop.LATCHED
        if latched and state is not SessionState.FAULTED:
            pressed = self._latch.read()
            if not (pressed and pressed.wall) and self._just_pressed():  # missing, or half written
                return
            self.estop = _PRESSED_BY(who=pressed.by, why=pressed.why) if pressed else _PRESSED
            yield HealthEvent(SessionEvent.ESTOPPED, _ESTOPPED(pressed=self.estop))
        elif not latched and state is SessionState.FAULTED:
            self.estop, self._pressed = "", None
            yield HealthEvent(SessionEvent.RELEASED, _RELEASED)

    def _just_pressed(self) -> bool:
        """Return True for a short time after the press of an e-stop, in which its latch may still be written.

        Control obeys the flag at once, but user and reason become known only with the latch.
        """
        now = self._clock.now()
        self._pressed = now if self._pressed is None else self._pressed
        return now - self._pressed < _LATCH_S

    def _leases(self, going: Run | None) -> Iterator[HealthEvent]:
        is_held = self._lease.current(self._people.now()) is not None
        if self._lease_held and not is_held:
            limit = self._goes_on_to(going)
            self._unattended = limit is not None
            if limit is None:
                yield HealthEvent(SessionEvent.LEASE_ENDED, _LEASE_ENDED)
            else:
                yield HealthEvent(SessionEvent.HOLDER_LOST, _GOES_ON(seconds=limit))
        elif is_held or going is None:
            self._unattended = False
        elif self._unattended and not self._stoppable():
            self._unattended = False
            yield HealthEvent(SessionEvent.LEASE_ENDED, _PANEL_GONE)
        self._lease_held = is_held

    def _goes_on_to(self, going: Run | None) -> float | None:
        """Return the duration [s] up to which a run continues although its lease holder was lost.

        None if it does not continue. Only a trial that has begun and has a limit of duration continues, and only if it
        can be stopped at the station's panel and the deployment does not demand a hold.
        """
        if self._plan.deployment.lease.lost == "hold" or not self._lease.lost(self._people.now()):
            return None
        scored = going is not None and going.trial and going.begun_at is not None
        return going.duration_s if going is not None and scored and self._stoppable() else None

    def _link(self) -> Iterator[HealthEvent]:
        record = self._shared_state.observation.read()
        if not record["sequence"]:
            return
        age = self._clock.now() - float(record["arrived"])
        missing = self.missing_cameras()
        if age < _CONNECTED_S and not missing:
            yield HealthEvent(SessionEvent.CONNECTED, _CONNECTED)
        elif age < _CONNECTED_S:
            silent = _NO_PICTURE(cameras=", ".join(missing))
            reason = series([silent, *describe_camera_problems(self._reception().cameras, missing)])
            yield HealthEvent(SessionEvent.INCOMPLETE, reason)
        elif age > _LINK_LOST_S and not record["last"]:
            yield HealthEvent(SessionEvent.LINK_LOST, _LINK_LOST(seconds=age, who=self._who_is_silent()))

    def _who_is_silent(self) -> str:
        now, within = self._clock.now(), self._plan.deployment.control.heartbeat_timeout_s
        if self._shared_state.alive("reception", now, within):
            return _ASK_FOR_NODE
        return _RECEPTION_SILENT

    def _end_of(self, run: Run) -> Iterator[HealthEvent]:
        limit = run.duration_s
        if limit is not None and run.elapsed(self._clock.now()) >= limit - _EARLY_S:
            yield HealthEvent(SessionEvent.RUN_ENDED, _TIME_OVER(seconds=limit))
            return
        record: np.void = self._shared_state.observation.read()
        if record["last"] and int(self._shared_state.control.read()["sequence"]) == int(record["sequence"]):
            yield HealthEvent(SessionEvent.RUN_ENDED, _SOURCE_ENDED)
