"""One control tick: obey orders, merge chunks, choose a target, judge it, send it, write it down."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from runtime.behaviour import Behaviour, EStopped, Follow, Hold, Move, Silent, Target
from runtime.messages import ChunkMerged, Event, Order, PostedChunk, TickDone, decode, encode
from runtime.motion import Brake, Trajectory
from runtime.page import EStop, Page
from runtime.safety import RobotState, SafetyFilter, SafetySettings
from runtime.strategies.base import Arrival, Merge
from runtime.timeline import Timeline
from runtime.transports.base import Sink
from runtime.types import Float64, RobotCommand


@dataclass(frozen=True, slots=True)
class TickSettings:
    """What a tick goes by; times in seconds."""

    period: float
    velocity: Float64  # [D] of motions of ours
    lower: Float64  # [D] joint limits
    upper: Float64
    binary: NDArray[np.bool_]  # [D] dimensions that switch and have no velocity
    safety: SafetySettings
    heartbeat_timeout: float
    starvation_hold: float


class Tick:
    """The control loop's body; owns the timeline and everything that is sent.

    A missed deadline is never caught up: the caller passes the step that is due now, and limits use the time
    since the last command, capped at 1.5 periods.
    """

    def __init__(
        self,
        page: Page,
        sink: Sink,
        safety: SafetyFilter,
        merge: Merge,
        settings: TickSettings,
        clock: Callable[[], float],
    ) -> None:
        self._page = page
        self._sink = sink
        self._safety = safety
        self._merge = merge
        self._settings = settings
        self._clock = clock
        self._dim = page.layout.dim
        self.timeline = Timeline(self._dim)
        self._resume_after_restart()
        self._order = 0
        self._run = 0
        self._refused = 0
        self._starved_since: float | None = None
        self._waiting = (
            True  # for the first chunk of a run: no starvation yet, the policy's deadline bounds it
        )
        self._outbox: list[ChunkMerged | Event] = []
        self._records_lost = 0
        self.orphaned = False

    def _resume_after_restart(self) -> None:
        """A restarted control goes on holding where its predecessor stood; a new one keeps silent."""
        before = self._page.control.read()
        self._commanded: Float64 = np.array(before["commanded"], np.float64)
        self._velocity = np.zeros(self._dim)
        self._last_planned = float("-inf")
        self._engaged = bool(before["engaged"])
        self._behaviour: Behaviour = Silent()
        if self._engaged:
            self._behaviour = self._holding(self._clock())

    def __call__(self, step: int, planned: float) -> None:
        """Do the tick `step`, planned for `planned` on our clock."""
        self._observation = self._page.observation.read()
        for payload in self._page.rings["orders"].drain():
            self._obey(decode(payload), step, planned)
        self._check_estop(planned)
        self._check_family(planned)
        sent_at, target, executed, notes, refused = self._send(step, planned)
        self._finish_motion(planned)
        self._write_status(step, planned, executed is not None)
        self._record(step, planned, sent_at, target, executed, notes, refused)
        self._last_planned = planned

    # --- orders and chunks ---------------------------------------------------------------------------------

    def _obey(self, message: object, step: int, now: float) -> None:
        if isinstance(message, PostedChunk):
            self._merge_chunk(message, step)
        elif isinstance(message, Order):
            self._order, self._run = message.number, message.run
            if not isinstance(self._behaviour, EStopped):
                self._follow_order(message, now)

    def _follow_order(self, order: Order, now: float) -> None:
        if order.kind == "silent":
            self._engaged = False
            self._behaviour = Silent()
        elif order.kind == "hold":
            self._hold(now)
        elif order.kind == "motion" and order.goal is not None:
            self._engage()
            rate = np.full(self._dim, self._settings.safety.motion_acceleration)
            path = Trajectory(self._commanded, order.goal, self._settings.velocity, rate)
            self._behaviour = Move(path, now)
        elif order.kind == "follow":
            self._engage()
            self._refused = 0
            self._starved_since = None
            self._waiting = True
            self.timeline.clear()
            self._behaviour = Follow(order.run, self.timeline)

    def _merge_chunk(self, chunk: PostedChunk, step: int) -> None:
        if not isinstance(self._behaviour, Follow) or chunk.run != self._run:
            why = "control is not following that run any more"
            targets = np.full(len(chunk.rows), -1, np.int64)
            delay = step - chunk.observation_step
            self._outbox.append(ChunkMerged(chunk.chunk_id, chunk.run, step, delay, targets, 0, why))
            return
        arrival = Arrival(chunk.chunk_id, chunk.observation_step, chunk.rows)
        if self._starved_since is not None and not self._merge.waits:
            # The plan ran out: blend the new chunk over from the target that is being held.
            self.timeline.replace(
                step, np.repeat(self._commanded[None], len(chunk.rows), 0), [()] * len(chunk.rows)
            )
        merged = self._merge(self.timeline, arrival, step)
        self._waiting = self._waiting and bool(merged.dropped)
        self._outbox.append(
            ChunkMerged(
                merged.chunk_id,
                chunk.run,
                merged.arrival_step,
                merged.delay,
                merged.targets,
                merged.mistimed,
                merged.dropped,
            )
        )

    # --- behaviours ----------------------------------------------------------------------------------------

    def _engage(self) -> None:
        """Take the robot over where it stands: from now on something is sent on every tick."""
        if not self._engaged:
            self._engaged = True
            self._commanded = np.array(self._observation["qpos"], np.float64)
            self._velocity = np.zeros(self._dim)

    def _hold(self, now: float) -> None:
        if self._engaged and not isinstance(self._behaviour, Hold):
            self._behaviour = self._holding(now)

    def _holding(self, now: float) -> Hold:
        return Hold(self._brake(), now - self._elapsed(now))  # the first point is already one tick on

    def _brake(self) -> Brake:
        """A stop from the last commanded velocity, as hard as needed to stay within the joint limits."""
        bounds, speed = self._settings, self._velocity
        ahead = np.where(speed > 0, bounds.upper - self._commanded, self._commanded - bounds.lower)
        needed = speed * speed / (2.0 * np.maximum(ahead, 1e-9))
        rate = np.clip(needed, bounds.safety.brake_acceleration, bounds.safety.acceleration)
        return Brake(self._commanded.copy(), speed.copy(), rate)

    def _hold_because(self, kind: str, reason: str, now: float) -> None:
        """Hold for a reason of control's own, and say so."""
        if self._behaviour.moving:
            self._hold(now)
            self._say(kind, reason, now)

    def _check_estop(self, now: float) -> None:
        latched = self._page.estop is EStop.LATCHED
        if latched and not isinstance(self._behaviour, EStopped):
            self._engage()
            self._behaviour = EStopped(self._commanded.copy())
            self._say("estopped", "e-stop", now)
        elif not latched and isinstance(self._behaviour, EStopped):
            self._behaviour = self._holding(now)
            self._say("released", "e-stop released", now)
        if isinstance(self._behaviour, EStopped):
            age = now - float(self._observation["joints_captured"])
            fresh = self._observation["sequence"] > 0 and age <= self._settings.safety.joint_age_s
            self._behaviour.see(np.array(self._observation["qpos"], np.float64) if fresh else None)

    def _check_family(self, now: float) -> None:
        if self.orphaned:
            self._hold_because("orphaned", "the supervisor is gone", now)
            return
        for process in ("main", "guard"):
            beat = self._page.last_beat(process)
            if now - beat > self._settings.heartbeat_timeout:
                since = f"for {now - beat:.1f} s" if beat else "since it was restarted"
                self._hold_because("family", f"no sign of life from {process} {since}", now)

    def _finish_motion(self, now: float) -> None:
        if isinstance(self._behaviour, Move) and self._behaviour.finished(now):
            self._behaviour = self._holding(now)
            self._say("motion_done", "arrived", now)

    # --- sending -------------------------------------------------------------------------------------------

    def _send(
        self, step: int, planned: float
    ) -> tuple[float, Target | None, Float64 | None, tuple[str, ...], bool]:
        target = self._behaviour.target(step, planned)
        if target is None and isinstance(self._behaviour, Follow):
            self._starve(planned)
            return self._stand(step, planned, None, ())
        if target is None or self._page.estop is EStop.UNKNOWN:
            return planned, None, None, (), False
        if target.path is None:
            return self._transmit(step, planned, target, target.action, ())
        verdict = self._safety.judge(target.action, self._state(planned), target.path)
        if verdict.action is None:
            return self._refuse(step, planned, target, verdict.notes)
        self._refused = 0
        self._recover(planned)
        return self._transmit(step, planned, target, verdict.action, verdict.notes)

    def _state(self, now: float) -> RobotState:
        seen = self._observation
        pictures = zip(self._page.layout.cameras, seen["picture_captured"], strict=False)
        return RobotState(
            previous=self._commanded,
            velocity=self._velocity,
            measured=np.array(seen["qpos"], np.float64),
            elapsed=self._elapsed(now),
            joint_age=now - float(seen["joints_captured"]),
            picture_ages={camera: now - float(captured) for camera, captured in pictures},
        )

    def _elapsed(self, now: float) -> float:
        period = self._settings.period
        return float(min(max(now - self._last_planned, period * 0.5), 1.5 * period))

    def _transmit(
        self, step: int, planned: float, target: Target, action: Float64, notes: tuple[str, ...]
    ) -> tuple[float, Target | None, Float64 | None, tuple[str, ...], bool]:
        sent_at = self._clock()
        if self._page.estop is EStop.LATCHED and target.source != "estop":
            # Pressed since this tick looked: the next one takes over, this one repeats the last command.
            action, notes = self._commanded, ("e-stop pressed within the tick",)
        self._sink.send(RobotCommand(action.astype(np.float32), step, sent_at))
        velocity = (action - self._commanded) / self._elapsed(planned)
        self._velocity = np.where(self._settings.binary, 0.0, velocity)
        self._commanded = action
        return sent_at, target, action, notes, False

    def _refuse(
        self, step: int, planned: float, target: Target, notes: tuple[str, ...]
    ) -> tuple[float, Target | None, Float64 | None, tuple[str, ...], bool]:
        self._refused += 1
        if self._refused == 1:
            self._say("refused", notes[-1], planned)
        if self._refused >= self._settings.safety.refusals_to_hold:
            count = self._refused
            self._hold_because(
                "refusals", f"{count} actions refused in a row, the last one: {notes[-1]}", planned
            )
        return self._stand(step, planned, target, notes, refused=True)

    def _stand(
        self, step: int, planned: float, target: Target | None, notes: tuple[str, ...], refused: bool = False
    ) -> tuple[float, Target | None, Float64 | None, tuple[str, ...], bool]:
        """Send the next point of a stop instead of what could not be sent."""
        if self._page.estop is EStop.UNKNOWN:
            return planned, target, None, notes, refused
        elapsed = self._elapsed(planned)
        point = self._brake().at(elapsed)
        sent_at, *_ = self._transmit(step, planned, Target(point, "hold", None), point, ())
        return sent_at, target, point, notes, refused

    def _starve(self, now: float) -> None:
        if self._merge.waits or self._waiting:
            return
        if self._starved_since is None:
            self._starved_since = now
            self._say("starved", "no action for this step: slowing down and holding", now)
        elif now - self._starved_since >= self._settings.starvation_hold:
            since = now - self._starved_since
            self._hold_because("starvation", f"no usable chunk for {since:.1f} s", now)

    def _recover(self, now: float) -> None:
        if self._starved_since is not None:
            self._say("recovered", f"actions again after {now - self._starved_since:.2f} s", now)
            self._starved_since = None

    # --- reporting -----------------------------------------------------------------------------------------

    def _say(self, kind: str, text: str, now: float) -> None:
        self._outbox.append(Event(kind, text, now))

    def _write_status(self, step: int, planned: float, sent: bool) -> None:
        status = self._page.control.read().copy()
        status["step"], status["planned"] = step, planned
        status["sequence"], status["order"] = self._observation["sequence"], self._order
        status["run"], status["behaviour"] = self._run, self._behaviour.name.encode()
        status["remaining"] = self.timeline.remaining(step + 1)
        status["engaged"], status["moving"] = self._engaged, self._behaviour.moving
        status["estop_obeyed"] = isinstance(self._behaviour, EStopped)
        status["commanded"], status["velocity"] = self._commanded, self._velocity
        status["refused_in_row"] = self._refused
        status["records_lost"] = self._records_lost
        self._page.control.write(status)
        # Only now: main decides by the status, and must not see an event that the status does not show yet.
        for message in self._outbox:
            self._push("control_events", encode(message))
            self._push("ticks", encode(message))
        self._outbox.clear()

    def _record(
        self,
        step: int,
        planned: float,
        sent_at: float,
        target: Target | None,
        executed: Float64 | None,
        notes: tuple[str, ...],
        refused: bool,
    ) -> None:
        wanted = target is not None and target.path is not None
        source = "none" if executed is None else "hold"
        if target is not None and executed is not None and not refused:
            source = target.source
        done = TickDone(
            step=step,
            run=self._run,
            planned=planned,
            sent=sent_at,
            sequence=int(self._observation["sequence"]),
            source=source,
            qpos=np.array(self._observation["qpos"]),
            smoothed=target.action.astype(np.float32) if target and wanted else None,
            executed=None if executed is None else executed.astype(np.float32),
            chunk_ids=[maker for maker, _ in target.makers] if target else [],
            weights=[share for _, share in target.makers] if target else [],
            notes=list(notes),
            refused=refused,
        )
        self._push("ticks", encode(done))

    def _push(self, ring: str, payload: bytes) -> None:
        if not self._page.rings[ring].push(payload):
            self._records_lost += 1
