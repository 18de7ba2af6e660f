"""Lockstep station: the same parts in one process on a virtual clock, deterministic and as fast as possible."""

from __future__ import annotations

import math
import mmap
import uuid
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from runtime.core.clock import Clock, VirtualClock
from runtime.core.errors import SetupError
from runtime.core.plugins import variants
from runtime.core.realtime import LOCKSTEP
from runtime.core.types import Observation
from runtime.ipc.estop_latch import Latch
from runtime.ipc.identity import LOCAL
from runtime.ipc.messages import Ack, Command
from runtime.ipc.session_state import SessionState
from runtime.ipc.shared_state import SharedState
from runtime.processes.control.process import make_sink, make_tick
from runtime.processes.coordinator.assembly import assemble
from runtime.processes.coordinator.builders import MakePolicy, make_policy
from runtime.processes.coordinator.inference.requests import PolicyResponse
from runtime.processes.coordinator.inference.runners import LockstepRunner, Runner
from runtime.processes.guard.process import Guard
from runtime.processes.lockstep.response_delay import draw_delay
from runtime.processes.media.process import Media, make_recorder
from runtime.processes.media.recorder import ClosedEpisode
from runtime.processes.media.unclosed_episodes import Close, at_once
from runtime.processes.reception.process import Reception, make_source
from runtime.station.spec import StationSpec
from runtime.transports.base import Sink, Source

_HOLDER = "lockstep"
_ROUNDING = 1e-6  # [ticks] that a delay of whole ticks may lie above them
Over = Callable[[bool], str]
"""Called before each tick with whether a run is active; returns why the run is over, or ""."""


@dataclass(frozen=True, slots=True)
class LockstepRun:
    """Result of a lockstep run: the closed episode, the last state and every event."""

    episode: dict[str, Any]
    state: SessionState
    reason: str
    ticks: int
    events: list[dict[str, Any]] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class LockstepEnvironment:
    """Environment of a lockstep station; by default it has no clients."""

    runner: Runner | None = None
    client_clock: Clock | None = None  # clock of leases and commands
    waits: Clock | None = None  # clock by which the guard waits
    preview: Callable[[Observation], None] = lambda observation: None
    closer: Callable[[Close], Future[ClosedEpisode]] = at_once
    on_disk: Callable[[Path], None] = lambda folder: None
    over: Over = lambda running: ""


@dataclass(frozen=True, slots=True)
class Peers:
    """Constructors of a station's source, sink and policy; by default those that its deployment names."""

    source: Callable[[StationSpec, Clock], Source] = make_source
    sink: Callable[[StationSpec, Clock], Sink] = make_sink
    policy: MakePolicy = make_policy


class Lockstep:
    """Station without processes; each `tick` runs reception, media, coordinator and control in that order.

    Pass the clock, the environment `around` and `peers` to let other code, for example a simulator, take part. In
    benchmark mode a run is over as soon as the observation shows it, before the policy is asked about it.
    """

    def __init__(
        self,
        spec: StationSpec,
        clock: VirtualClock | None = None,
        around: LockstepEnvironment | None = None,
        peers: Peers | None = None,
    ) -> None:
        self.spec = spec
        self.clock = clock = clock or VirtualClock()
        self.shared = SharedState(spec.layout, mmap.mmap(-1, SharedState.size(spec.layout)))
        settings, around, peers = spec.deployment, around or LockstepEnvironment(), peers or Peers()
        waits = around.waits or clock
        self.guard = Guard(self.shared, Latch(settings.station_dir), waits, 1.0 / spec.rate, settings.station)
        self._source = peers.source(spec, clock)
        self._sink = peers.sink(spec, clock)
        recorder = make_recorder(spec, clock.now, patient=True)
        self.media = Media(self.shared, recorder, clock, around.preview, around.closer, around.on_disk)
        self.reception = Reception(self.shared, self._source, clock, LOCKSTEP)
        self._over = around.over
        self._benchmark = settings.lockstep.benchmark
        self._runner = around.runner or LockstepRunner(self.delayed)
        self.coordinator = assemble(spec, self.shared, clock, self._runner, around.client_clock, peers.policy)
        self._tick = make_tick(spec, self.shared, self._sink, self.clock.now)
        self.step = 0

    def connect(self) -> None:
        """Open source and sink. Raises TransportError."""
        self._source.connect()
        self._sink.connect()

    def tick(self) -> None:
        """Run one control period; if the source's run is over, the station's run ends within this period."""
        self._observe()
        self._act()

    def _observe(self) -> None:
        """Run the first part of a control period: receive an observation, and ask the policy if it is time."""
        if not self._benchmark:
            self._end_if_over()
        now = self.clock.now()
        for process in ("control", "guard", "reception", "media"):
            self.shared.beat(process, now)
        self.guard.poll()
        self.reception.poll(0.0)
        self.media.poll()
        if self.reception.poll_commands():  # a run begins with its source, in this tick
            self.media.poll()
        if self._benchmark:
            self._end_if_over()
        self.coordinator.poll()

    def _act(self) -> None:
        """Run the second part of a control period: send the robot its command."""
        self._tick(self.step, self.clock.now())
        self._runner.tick()
        self.step += 1
        self._advance_clock()

    def _end_if_over(self) -> None:
        if reason := self._over(self.coordinator.session.state is SessionState.RUNNING):
            if self._benchmark:  # what was reached by the last row belongs to the run
                self.reception.report()
                self.coordinator.inbox.poll()
            self.coordinator.end_source_run(reason)

    def delayed(self, result: Any) -> tuple[Any, int]:
        """Return what a call to the policy returned, a response with its declared latency, and its delay [ticks].

        Neither depends on how long the call took.
        """
        ticks = self.spec.deployment.lockstep.delay_ticks
        if not isinstance(result, PolicyResponse):
            return result, ticks
        provenance, number = self.coordinator.runs.provenance, self.coordinator.inference.metrics.answers
        seconds = draw_delay(provenance.spec, provenance.bench.get("seed", 0), number)
        if seconds is None:
            return replace(result, seconds=ticks / self.spec.rate), ticks
        return replace(result, seconds=seconds), math.ceil(seconds * self.spec.rate - _ROUNDING)

    def _advance_clock(self) -> None:
        """Advance the clock to the next tick, computed from the start: tick k is exactly at k / rate."""
        self.clock.sleep_until(self.step / self.spec.rate)

    def command(self, kind: str, **arguments: Any) -> Ack:
        """Execute a command under a lease of lockstep's own. Raises SetupError if the command is refused."""
        self._handle("lease_claim")
        ack = self._handle(kind, arguments)
        if ack.status == "refused":
            raise SetupError(f"{kind}: {ack.reason.removeprefix(f'{kind}: ')}")
        return ack

    def _handle(self, kind: str, arguments: Mapping[str, Any] | None = None) -> Ack:
        session = self.coordinator.session
        return self.coordinator.handle(
            Command(
                str(uuid.uuid4()),
                kind,
                arguments or {},
                user=_HOLDER,
                holder=_HOLDER,
                epoch=0 if kind == "lease_claim" else self.coordinator.lease.epoch,
                boot=self.coordinator.boot,
                sequence=session.sequence,
                role=LOCAL,
            )
        )

    def until(self, reached: Callable[[], bool], seconds: float, what: str) -> SessionState:
        """Execute ticks until `reached()` returns True; return the state that the session has after the last tick.

        Raises SetupError, which names `what`, after `seconds` [s] of virtual time.
        """
        end = self.clock.now() + seconds
        while not reached():
            if self.clock.now() > end:
                session = self.coordinator.session
                raise SetupError(f"{what}: not within {seconds:g} s; {session.state}: {session.reason}")
            self._handle("lease_renew" if self.coordinator.lease.current(self.clock.now()) else "lease_claim")
            self.tick()
        return self.coordinator.session.state

    def close(self) -> None:
        """Close the episode, the policy, source and sink."""
        self.media.poll()
        self.media.end("interrupted", "lockstep ended")
        self.coordinator.close()
        self._source.close()
        self._sink.close()


def check(spec: StationSpec) -> None:
    """Raise SetupError if the peer of the transport runs in real time.

    Its stamps have no relation to the virtual clock: a run would only hold because joints seem too old.
    """
    kind = spec.deployment.transport.kind
    modules = variants("runtime.transports")
    if getattr(modules[kind], "REAL_TIME", False):
        lasting = (name for name, module in modules.items() if not getattr(module, "REAL_TIME", False))
        allowed = ", ".join(sorted(lasting))
        raise SetupError(
            f"transport.kind = {kind!r} with --lockstep: its other end runs in real time, and lockstep has a "
            f"clock of its own; allowed: {allowed}, or leave --lockstep out"
        )


def run(
    spec: StationSpec,
    longest: float = 3600.0,
    peers: Peers | None = None,
    clock: VirtualClock | None = None,
    over: Over = lambda running: "",
    orders: Mapping[str, Mapping[str, Any]] | None = None,
) -> LockstepRun:
    """Set up, run until the source's end or for run.duration_s, and close.

    Args:
        spec: The station.
        longest: Bound of the run's virtual time [s].
        peers: As in `Lockstep`; they share `clock`.
        clock: Virtual clock of the station.
        over: Called before each tick; it ends the run by returning why.
        orders: Arguments of the commands "setup" and "run".

    Raises:
        RuntimeFault: If the station cannot be set up, or the run does not end.
    """
    station = Lockstep(spec, clock, LockstepEnvironment(over=over), peers)
    session, orders = station.coordinator.session, orders or {}
    try:
        station.connect()
        station.until(lambda: session.state is not SessionState.DISCONNECTED, 5.0, "first observation")
        station.command("setup", **orders.get("setup", {}))
        prepared = station.until(lambda: session.state is not SessionState.SETTING_UP, 120.0, "set-up")
        if prepared is not SessionState.READY:
            raise SetupError(f"set-up failed: {session.reason}")
        station.command("run", **orders.get("run", {}))
        how = station.until(lambda: session.state is not SessionState.RUNNING, longest, "run")
        reason = session.reason
        if how is SessionState.HOLDING:
            station.command("stop")
        for _ in range(3):  # the end passes from the coordinator to media and back
            station.tick()
        return LockstepRun(
            station.coordinator.runs.last_episode,
            how,
            reason,
            station.step,
            station.coordinator.events.since(0),
        )
    finally:
        station.close()
