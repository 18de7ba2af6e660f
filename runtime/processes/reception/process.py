"""Reception process: receives every observation and puts it where control, the coordinator and media read it."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from robots import Robot
from runtime.core import process_limits as heap
from runtime.core import realtime
from runtime.core.clock import Clock, MonotonicClock
from runtime.core.errors import RuntimeFault
from runtime.core.plugins import variants
from runtime.core.sentences import Pattern
from runtime.core.types import Observation
from runtime.ipc.membership import rest_s
from runtime.ipc.messages import BeginRun, EndRun, Event, Message, ReceptionReport, RunBegun, decode, encode
from runtime.ipc.observation_messages import as_message
from runtime.ipc.shared_state import SharedState
from runtime.processes.child import join_station
from runtime.processes.reception.receiver import ObservationReceiver
from runtime.station.spec import StationSpec, delivered_cameras
from runtime.transports.base import Source

log = logging.getLogger(__name__)
_CLASS_GIVEN_UP = Pattern(
    "reception.class_given_up",
    "receiving took more than a processor core for {seconds:g} s and gives its real-time class up: see "
    "what the robot's node and the cameras send; the class is back when the station is started anew",
)
# Packages of a deployment that others may write: a fault in their modules must not prevent reception.
_UNREAD = ("runtime.policies", "runtime.teleoperators", "runtime.kinematics", "runtime.strategies")
_REPORT_PERIOD = 0.2
_WAIT_S = 0.05  # longest wait for an observation, until media's messages are read again [s]
_RETRY_S = 1.0  # pause between attempts to connect [s]
_SHARE_S = 3.0


class CpuShare:
    """Processor time of this process, measured over periods of `_SHARE_S` seconds."""

    def __init__(self) -> None:
        self._since: tuple[float, float] | None = (
            None  # start of the period, and processor time at that moment [s]
        )

    def exceeds_core(self, now: float, taken: float) -> bool:
        """Return True if this process used more than one core during the last whole period.

        `taken` is the processor time that it has used since its start [s]. Return False if no period ends at `now`.
        """
        since = self._since or (now, taken)
        if now - since[0] < _SHARE_S:
            self._since = since
            return False
        self._since = now, taken
        return taken - since[1] > now - since[0]


class Reception:
    """Reception of one station; `poll` handles all waiting messages. Lockstep calls it tick by tick."""

    def __init__(self, shared: SharedState, source: Source, clock: Clock, scheduling: str = "") -> None:
        self._shared_state = shared
        self._clock = clock
        self._scheduling = scheduling
        self._intake = ObservationReceiver(shared, source, clock, self._emit, self._hand_on)
        self._begun: RunBegun | None = None  # media has not been informed yet
        self._next_report = 0.0
        self._milestones: Any = None  # of the simulated bench, as last reported
        self._missed = 0  # observations for which media had no room
        for _ in shared.rings["source"].drain():
            pass  # addressed to a predecessor that died

    def poll(self, timeout: float) -> None:
        """Handle media's commands, receive one observation within `timeout` [s], and send a report if it is due."""
        self.poll_commands()
        self._intake.poll(timeout)
        self._report_in_time()

    def poll_disconnected(self) -> None:
        """Handle media's commands, and send a report if it is due, while the source is not connected."""
        self.poll_commands()
        self._report_in_time()

    def leave_realtime(self) -> None:
        """Leave the real-time class and emit an event.

        Needed if the incoming data use so much processor time that reception in this class would block guard and
        coordinator.
        """
        realtime.leave_realtime_all()
        self._scheduling = "ordinary"
        text = _CLASS_GIVEN_UP(seconds=_SHARE_S)
        self._emit(Event("scheduling", text, self._clock.now()))

    def _report_in_time(self) -> None:
        """Send a report if it is due, or if a milestone of a simulated bench has changed: its time counts."""
        milestones = self._intake.truth.get("milestones")
        if self._clock.now() >= self._next_report or milestones != self._milestones:
            self._milestones = milestones
            self.report()

    def poll_commands(self) -> bool:
        """Read the requests of media, and start or end the run of the source accordingly.

        Return True if a run of the source has begun and media was informed of it.
        """
        for payload in self._shared_state.rings["source"].drain():
            message = decode(payload)
            if isinstance(message, BeginRun):
                self._intake.begin_run()
                self._begun = RunBegun(message.run, message.generation)
            elif isinstance(message, EndRun):
                self._intake.end_run()
        if self._begun is None or not self._record(self._begun):
            return False
        self._begun = None
        return True

    def report(self) -> None:
        """Send the coordinator a report; `poll` does this five times a second."""
        intake, now = self._intake, self._clock.now()
        self._next_report = now + _REPORT_PERIOD
        faults, rates = intake.faults(), intake.rates()
        fields = (intake.truth, intake.drives, intake.cameras, intake.age_ms(), self._scheduling)
        self._send(ReceptionReport(now, rates, faults, *fields))

    def _hand_on(self, observation: Observation, numbers: Mapping[str, int]) -> None:
        """Send an observation to media.

        This precedes its publication, so that media has the observation of every tick that uses it.
        """
        if self._record(as_message(observation, numbers)):
            self._missed = 0
            return
        self._missed += 1
        if self._missed == 1:
            log.warning("media does not read: rows miss what is observed now")

    def _emit(self, event: Event) -> None:
        """Send an event of reception to the coordinator, and to media for the episode."""
        self._send(event)
        if not self._record(event):
            log.warning("media does not read: %s is missing from the record", event.kind)

    def _record(self, message: Message) -> bool:
        return self._shared_state.rings["observations"].push(encode(message))

    def _send(self, message: Message) -> None:
        if not self._shared_state.rings["reception_events"].push(encode(message)):
            log.warning("the coordinator does not read: %s lost", type(message).__name__)


def make_source(
    spec: StationSpec, clock: Clock, build: Callable[[Any, Robot, Clock], Source] | None = None
) -> Source:
    """Create the source of observations, not yet connected.

    It is the transport's source, with the deployment's own cameras added. The transport must not wait for pictures of
    cameras that the deployment opens itself. Therefore the transport gets a description of the robot without those of
    these cameras that it would otherwise deliver. Cameras that the transport does not deliver anyway remain in the
    description. `build` replaces the constructor of the transport's kind.
    """
    settings = spec.deployment
    own = settings.cameras.keys() & set(delivered_cameras(settings, spec.robot))
    robot = replace(spec.robot, cameras=tuple(c for c in spec.robot.cameras if c.key not in own))
    build = build or variants("runtime.transports")[settings.transport.kind].source
    source = build(settings.transport, robot, clock)
    if not settings.cameras:
        return source
    from runtime.cameras.attach import attach_cameras

    return attach_cameras(source, settings.cameras, clock)


def main() -> None:
    """Receive until the supervisor and control have ended."""
    heap.keep_freed_memory()
    member = join_station("reception", unread=_UNREAD)
    shared, clock = member.shared, MonotonicClock()
    shared.beat("reception", clock.now())
    scheduling = _scheduling(member.spec)  # before other threads exist, which inherit the class
    log.info("receiving, scheduling %s", scheduling)
    source = make_source(member.spec, clock)
    reception = Reception(shared, source, clock, scheduling)
    connected, retry_at = False, 0.0
    wait = min(_WAIT_S, rest_s(member.spec.deployment.control.heartbeat_timeout_s))
    share = CpuShare() if scheduling.startswith("FIFO") else None
    while member.is_needed(clock.now()):
        now = clock.now()
        shared.beat("reception", now)
        if share is not None and share.exceeds_core(now, time.process_time()):
            reception.leave_realtime()
            share = None
        if not connected and now >= retry_at:
            connected, retry_at = _connected(source), now + _RETRY_S
        if connected:
            reception.poll(wait)
        else:
            reception.poll_disconnected()
            clock.sleep_until(now + wait)
    source.close()


def _scheduling(spec: StationSpec) -> str:
    """Return the obtained scheduling class; the real-time class is requested only if the source is a robot."""
    settings = spec.deployment.control
    if settings.realtime == "off" or not spec.capabilities.moves_robot:
        return "ordinary"
    return realtime.enter_realtime_below(settings.realtime_priority)


def _connected(source: Source) -> bool:
    """Connect the source; return False, after logging the reason, if that fails."""
    try:
        source.connect()
    except RuntimeFault as error:
        log.warning("%s", error)
        return False
    return True


if __name__ == "__main__":
    main()
