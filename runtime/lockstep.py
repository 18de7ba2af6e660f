"""The same parts in one process on a virtual clock: deterministic, and as fast as the machine allows."""

from __future__ import annotations

import logging
import mmap
import uuid
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from runtime.clock import VirtualClock
from runtime.control import make_tick
from runtime.director import Director
from runtime.errors import SetupError
from runtime.family import Plan
from runtime.guard import Guard
from runtime.latch import Latch
from runtime.media import Media, make_recorder
from runtime.messages import Ack, Command
from runtime.page import Page
from runtime.plugins import variants
from runtime.runner import LockstepRunner
from runtime.transitions import State

log = logging.getLogger(__name__)
_HOLDER = "lockstep"


@dataclass(frozen=True, slots=True)
class LockstepRun:
    """How a lockstep run went: the episode as media closed it, the last state, every event."""

    episode: dict[str, Any]
    state: State
    reason: str
    ticks: int
    events: list[dict[str, Any]] = field(default_factory=list)


class Lockstep:
    """One station without processes; each `tick` is media, main, control in that order."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.clock = VirtualClock()
        self.page = Page(plan.layout, mmap.mmap(-1, Page.size(plan.layout)))
        settings = plan.deployment
        self.guard = Guard(self.page, Latch(settings.station_dir), self.clock, 1.0 / plan.rate)
        self._source = plan.source(self.clock)
        self._sink = plan.transport.sink(settings.transport, plan.robot, self.clock)
        recorder = make_recorder(plan, self.clock.now, patient=True)
        self.media = Media(self.page, self._source, recorder, self.clock)
        self._runner = LockstepRunner(settings.lockstep.delay_ticks)
        self.main = Director(plan, self.page, self.clock, self._runner)
        self._tick = make_tick(plan, self.page, self._sink, self.clock.now)
        self.step = 0

    def connect(self) -> None:
        """Open source and sink; raises TransportError."""
        self._source.connect()
        self._sink.connect()

    def tick(self) -> None:
        """One control period."""
        now = self.clock.now()
        for process in ("control", "guard", "media"):
            self.page.beat(process, now)
        self.guard.watch()
        self.media.pump(0.0)
        self.main.pump()
        self._tick(self.step, now)
        self._runner.tick()
        self.step += 1
        # From the start and not by adding up, so that tick k is at k / rate exactly.
        self.clock.sleep_until(self.step / self.plan.rate)

    def command(self, kind: str, **arguments: Any) -> Ack:
        """Give a command under a lease of lockstep's own; raises SetupError where it is refused."""
        self._handle("lease_claim")
        ack = self._handle(kind, arguments)
        if ack.status == "refused":
            raise SetupError(f"{kind}: {ack.reason.removeprefix(f'{kind}: ')}")
        return ack

    def _handle(self, kind: str, arguments: Mapping[str, Any] | None = None) -> Ack:
        session = self.main.session
        return self.main.handle(
            Command(
                str(uuid.uuid4()),
                kind,
                arguments or {},
                user=_HOLDER,
                holder=_HOLDER,
                epoch=0 if kind == "lease_claim" else self.main.lease.epoch,
                boot=self.main.boot,
                sequence=session.sequence,
            )
        )

    def until(self, reached: Callable[[], bool], seconds: float, what: str) -> State:
        """Tick until `reached`, return the state then; raises SetupError after `seconds` of virtual time."""
        end = self.clock.now() + seconds
        while not reached():
            if self.clock.now() > end:
                session = self.main.session
                raise SetupError(f"{what}: not within {seconds:g} s; {session.state}: {session.reason}")
            self._handle("lease_renew" if self.main.lease.current(self.clock.now()) else "lease_claim")
            self.tick()
        return self.main.session.state

    def close(self) -> None:
        """Close the episode, the policy, source and sink."""
        self.media.digest()
        self.media.end("interrupted", "lockstep ended")
        self.main.close()
        self._source.close()
        self._sink.close()


def check(plan: Plan) -> None:
    """Raise SetupError where what is at the other end of the transport goes on by itself.

    Its messages are stamped in a time that the virtual clock does not have: a run would only hold, for the age of
    its joints.
    """
    kind = plan.deployment.transport.kind
    if getattr(plan.transport, "REAL_TIME", False):
        known = variants("runtime.transports").items()
        allowed = ", ".join(sorted(name for name, module in known if not getattr(module, "REAL_TIME", False)))
        raise SetupError(
            f"transport.kind = {kind!r} with --lockstep: what is at its other end goes on in real time, and lockstep "
            f"has a clock of its own; allowed: {allowed}, or leave --lockstep out"
        )


def run(plan: Plan, longest: float = 3600.0) -> LockstepRun:
    """Set up, run to the end of the source or of run.duration_s, close; raises RuntimeFault where it cannot.

    `longest` bounds the virtual time of the run [s].
    """
    station = Lockstep(plan)
    session = station.main.session
    try:
        station.connect()
        station.until(lambda: session.state is not State.DISCONNECTED, 5.0, "first observation")
        station.command("setup")
        prepared = station.until(lambda: session.state is not State.SETTING_UP, 120.0, "set-up")
        if prepared is not State.READY:
            raise SetupError(f"set-up failed: {session.reason}")
        station.command("run")
        how = station.until(lambda: session.state is not State.RUNNING, longest, "run")
        why = session.reason
        if how is State.HOLDING:
            station.command("stop")
        for _ in range(3):  # the end goes from main to media and back
            station.tick()
        return LockstepRun(
            station.main.runs.last_episode, how, why, station.step, station.main.events.since(0)
        )
    finally:
        station.close()
