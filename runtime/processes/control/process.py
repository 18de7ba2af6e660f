"""Control process: a loop with absolute deadlines in one thread."""

from __future__ import annotations

import gc
import logging
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from runtime.core import realtime
from runtime.core.clock import Clock, MonotonicClock
from runtime.core.errors import RuntimeFault
from runtime.core.plugins import variants
from runtime.core.quantiles import quantiles
from runtime.ipc.lifeline import Lifeline
from runtime.ipc.shared_state import SharedState
from runtime.processes.child import join_station
from runtime.processes.control.chunk_execution import Strategy
from runtime.processes.control.telemetry import StatusRecord
from runtime.processes.control.tick import Tick, TickSettings
from runtime.safety.collision import Collisions
from runtime.safety.filter import SafetyFilter
from runtime.safety.workspace import Workspace
from runtime.spaces.binary_grippers import binary_grippers_of
from runtime.station.spec import StationSpec
from runtime.transports.base import Sink

if TYPE_CHECKING:
    from runtime.spaces.pose_rows import PosePublisher

log = logging.getLogger(__name__)
_LATENESS_KEPT = 2000
# Sections for other processes: errors in their modules must not stop control.
_UNREAD = ("runtime.policies", "runtime.teleoperators", "runtime.cameras", "runtime.kinematics")


def make_sink(spec: StationSpec, clock: Clock) -> Sink:
    """Return the transport's sink for commands, not yet connected."""
    settings = spec.deployment.transport
    sink: Sink = variants("runtime.transports")[settings.kind].sink(settings, spec.robot, clock)
    return sink


def make_publisher(spec: StationSpec) -> PosePublisher | None:
    """Return the converter of joint commands to published poses; None if only joints are published."""
    publication, robot = spec.deployment.publication, spec.robot
    if publication.space == "joint":
        return None
    from runtime.kinematics.base import ChainForward
    from runtime.spaces.end_effectors import EndEffectors
    from runtime.spaces.pose_rows import PosePublisher, PoseRows

    return PosePublisher(
        PoseRows(publication.pose, robot, "publication.pose"), EndEffectors(robot, ChainForward(robot))
    )


def make_tick(spec: StationSpec, shared: SharedState, sink: Sink, now: Callable[[], float]) -> Tick:
    """Return the tick of a deployment; the same object in real time and in lockstep."""
    deployment, limits = spec.deployment, spec.limits
    merging = variants("runtime.strategies")[deployment.strategy.kind]
    workspace = Workspace(spec.robot, deployment.safety.workspace)
    collisions = Collisions(spec.robot, deployment.safety.collision_margin)
    return Tick(
        shared,
        sink,
        SafetyFilter(deployment.safety, limits, workspace if workspace.arms else None, collisions),
        Strategy(deployment.strategy.kind, merging.merge(deployment.strategy, spec.dims)),
        TickSettings(
            period=1.0 / spec.rate,
            limits=limits,
            dims=spec.dims,
            safety=deployment.safety,
            heartbeat_timeout=deployment.heartbeat_timeout_s,
            starvation=deployment.faults.starvation,
            starvation_hold=deployment.control.starvation_hold_s,
            moves_robot=spec.capabilities.moves_robot,
            switches=binary_grippers_of(spec.robot),
            publication=make_publisher(spec),
        ),
        now,
    )


class Lateness:
    """Lateness of the last `_LATENESS_KEPT` ticks."""

    def __init__(self, status: StatusRecord, scheduling: str) -> None:
        self._status = status
        self._late = np.zeros(_LATENESS_KEPT)  # [s]
        self._count = 0
        self._ticks, self._missed = int(status["ticks"]), int(status["missed"])
        status["scheduling"] = scheduling.encode()

    def add(self, lateness: float, missed: int) -> None:
        """Add the lateness [s] of one tick, and the number of ticks missed before it."""
        self._late[self._count % _LATENESS_KEPT] = lateness
        self._count += 1
        self._ticks += 1
        self._missed += missed

    def write(self) -> None:
        """Write the statistics to control's status; the next tick writes that to shared state."""
        status, late = self._status, self._late[: min(self._count, _LATENESS_KEPT)]
        status["ticks"], status["missed"] = self._ticks, self._missed
        if len(late):
            p50, p99, p999, worst = quantiles(late, (0.5, 0.99, 0.999, 1.0))
            status["lateness_p50"], status["lateness_p99"] = p50, p99
            status["lateness_p999"], status["lateness_max"] = p999, worst


class Loop:
    """Loop with ticks at start + n * period; a missed tick is skipped and counted, never caught up."""

    def __init__(self, tick: Tick, shared: SharedState, clock: Clock, rate: float, scheduling: str) -> None:
        self._tick = tick
        self._shared_state = shared
        self._clock = clock
        self._period = 1.0 / rate
        self._lateness = Lateness(tick.status, scheduling)
        self._step = int(shared.control.read()["step"]) + 1
        self._start = clock.now() + self._period
        self._n = 0
        self._collect_at = 0.0

    def tick_once(self) -> None:
        """Wait for the next deadline and execute its tick."""
        deadline = self._start + self._n * self._period
        self._clock.sleep_until(deadline)
        now = self._clock.now()
        # Absolute deadlines: a late wake-up does not shift later ticks. Whole periods that have passed are
        # skipped in time and in step number, so that step k stays due at start + k / rate.
        missed = max(0, int((now - deadline) / self._period))
        self._n += missed
        self._step += missed
        planned = deadline + missed * self._period
        self._shared_state.beat("control", now)
        self._tick(self._step, planned, now)
        self._lateness.add(now - deadline, missed)
        self._n += 1
        self._step += 1
        if now >= self._collect_at:
            self._lateness.write()
            gc.collect(0)
            self._collect_at = now + 1.0


def main() -> None:
    """Tick until the supervisor has ended, then hold for a while, then end."""
    member = join_station("control", pictures=False, unread=_UNREAD)
    spec, shared = member.spec, member.shared
    clock = MonotonicClock()
    for _ in shared.rings["orders"].drain():
        pass  # for a predecessor that died: its motions must not be continued
    sink = make_sink(spec, clock)
    _connect(sink, clock, member.lifeline)
    tick = make_tick(spec, shared, sink, clock.now)
    settings = spec.deployment.control
    scheduling = (
        realtime.enter_realtime(settings.realtime_priority) if settings.realtime == "auto" else "ordinary"
    )
    log.info("ticking at %g Hz, scheduling %s", spec.rate, scheduling)
    loop = Loop(tick, shared, clock, spec.rate, scheduling)
    while not member.lifeline.is_cut:
        loop.tick_once()
    log.info(
        "the supervisor has ended: holding what is commanded for %g s, then ending", settings.orphan_hold_s
    )
    hold_then_end(loop, tick, shared, clock, settings.orphan_hold_s)
    sink.close()
    shared.beat("control", 0.0)  # shows control's end at once, not by an expired heartbeat


def hold_then_end(loop: Loop, tick: Tick, shared: SharedState, clock: Clock, seconds: float) -> None:
    """Take the robot back from its node, and hold the commanded position for `seconds`, if it is engaged."""
    tick.hold_orphaned()
    until = clock.now() + seconds
    loop.tick_once()
    while tick.is_handing_over or (clock.now() < until and shared.control.read()["engaged"]):
        loop.tick_once()


def _connect(sink: Sink, clock: Clock, lifeline: Lifeline) -> None:
    while not lifeline.is_cut:
        try:
            sink.connect()
        except RuntimeFault as error:
            log.warning("%s", error)
            clock.sleep_until(clock.now() + 1.0)
        else:
            return


if __name__ == "__main__":
    main()
