"""The process that ticks: absolute deadlines, one thread, nothing else."""

from __future__ import annotations

import gc
import logging
from collections import deque
from collections.abc import Callable

import numpy as np

from runtime import realtime
from runtime.clock import Clock, MonotonicClock
from runtime.errors import RuntimeFault
from runtime.family import Lifeline, Plan, join
from runtime.page import Page
from runtime.safety import SafetyFilter
from runtime.tick import Tick, TickSettings
from runtime.transports.base import Sink
from runtime.types import Float64

log = logging.getLogger(__name__)
_LATENESS_KEPT = 2000


def make_tick(plan: Plan, page: Page, sink: Sink, now: Callable[[], float]) -> Tick:
    """The tick of a deployment; the same object in real time and in lockstep."""
    settings, limits = plan.deployment.safety, plan.limits
    merge = plan.strategy.merge(plan.deployment.strategy, plan.robot.binary_dims)
    return Tick(
        page,
        sink,
        SafetyFilter(settings, limits, _outside(plan)),
        merge,
        TickSettings(
            period=1.0 / plan.rate,
            velocity=limits.velocity * settings.motion_velocity_scale,
            lower=limits.lower,
            upper=limits.upper,
            grippers=limits.grippers,
            binary=limits.binary,
            reach=limits.reach,
            safety=settings,
            heartbeat_timeout=plan.deployment.control.heartbeat_timeout_s,
            starvation_hold=plan.deployment.control.starvation_hold_s,
        ),
        now,
    )


def _outside(plan: Plan) -> Callable[[Float64], tuple[str, ...]] | None:
    """Names the arms whose end effector would leave its box; None where no box is declared."""
    boxes = plan.deployment.safety.workspace
    if not boxes:
        return None
    spaces = plan.spaces()
    arms = [
        (index, arm.name, np.array(boxes[arm.name].lower), np.array(boxes[arm.name].upper))
        for index, arm in enumerate(plan.robot.arms)
        if arm.name in boxes
    ]

    def outside(action: Float64) -> tuple[str, ...]:
        poses = spaces.eef_of(action).reshape(len(plan.robot.arms), -1)
        return tuple(
            name
            for index, name, lower, upper in arms
            if (poses[index, :3] < lower).any() or (poses[index, :3] > upper).any()
        )

    return outside


class Lateness:
    """How late ticks begin, over the last seconds; figures renewed once a second."""

    def __init__(self, page: Page, scheduling: str) -> None:
        self._page = page
        self._late: deque[float] = deque(maxlen=_LATENESS_KEPT)
        self._scheduling = scheduling.encode()
        self.ticks = int(page.control.read()["ticks"])
        self.missed = int(page.control.read()["missed"])
        self._renewed = 0.0
        self._p50 = self._p99 = self._max = 0.0

    def add(self, lateness: float, missed: int, now: float) -> None:
        """Count one tick."""
        self._late.append(lateness)
        self.ticks += 1
        self.missed += missed
        if now - self._renewed >= 1.0:
            self._renewed = now
            late = np.array(self._late)
            self._p50, self._p99 = np.percentile(late, (50, 99))
            self._max = float(late.max())

    def write(self) -> None:
        """Add the figures to control's status."""
        status = self._page.control.read().copy()
        status["ticks"], status["missed"] = self.ticks, self.missed
        status["lateness_p50"], status["lateness_p99"] = self._p50, self._p99
        status["lateness_max"], status["scheduling"] = self._max, self._scheduling
        self._page.control.write(status)


class Loop:
    """Wakes at start + n * period; a tick that was missed is skipped and counted, never caught up."""

    def __init__(self, tick: Tick, page: Page, clock: Clock, rate: float, scheduling: str) -> None:
        self._tick = tick
        self._page = page
        self._clock = clock
        self._period = 1.0 / rate
        self._lateness = Lateness(page, scheduling)
        self._step = int(page.control.read()["step"]) + 1
        self._start = clock.now() + self._period
        self._n = 0
        self._collect_at = 0.0

    def once(self) -> None:
        """Wait for the next deadline and do its tick."""
        deadline = self._start + self._n * self._period
        self._clock.sleep_until(deadline)
        now = self._clock.now()
        missed = max(0, int((now - deadline) / self._period))
        self._n += missed
        self._step += missed
        planned = deadline + missed * self._period
        self._page.beat("control", now)
        self._tick(self._step, planned)
        self._lateness.add(now - planned if not missed else now - deadline, missed, now)
        self._n += 1
        self._step += 1
        if now >= self._collect_at:
            self._lateness.write()
            gc.collect(0)
            self._collect_at = now + 1.0


def main() -> None:
    """Tick until the supervisor is gone, then hold for a while, then end."""
    member = join("control", pictures=False)
    plan, page = member.plan, member.page
    clock = MonotonicClock()
    for _ in page.rings["orders"].drain():
        pass  # given to a predecessor that died: its motions are not ours to finish
    sink: Sink = plan.transport.sink(plan.deployment.transport, plan.robot, clock)
    _connect(sink, clock, member.lifeline)
    tick = make_tick(plan, page, sink, clock.now)
    settings = plan.deployment.control
    scheduling = realtime.enter(settings.realtime_priority) if settings.realtime == "auto" else "ordinary"
    log.info("ticking at %g Hz, scheduling %s", plan.rate, scheduling)
    loop = Loop(tick, page, clock, plan.rate, scheduling)
    while not member.lifeline.cut:
        loop.once()
    log.info("the supervisor has ended: holding for %g s, then ending", settings.orphan_hold_s)
    tick.orphaned = True
    until = clock.now() + settings.orphan_hold_s
    while clock.now() < until:
        loop.once()
    sink.close()


def _connect(sink: Sink, clock: Clock, lifeline: Lifeline) -> None:
    while not lifeline.cut:
        try:
            sink.connect()
        except RuntimeFault as error:
            log.warning("%s", error)
            clock.sleep_until(clock.now() + 1.0)
        else:
            return


if __name__ == "__main__":
    main()
