"""One control tick: obey orders, merge chunks, choose a target, judge it, send it, write it down."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from runtime.actuator import Actuator, Sent, TickSettings
from runtime.behaviour import Behaviour, EStopped, Follow, Hold, Move, Silent, Target
from runtime.messages import ChunkMerged, Order, PostedChunk, decode
from runtime.motion import Trajectory
from runtime.page import EStop, Page
from runtime.report import Report
from runtime.safety import RobotState, SafetyFilter
from runtime.strategies.base import Arrival, Merge
from runtime.timeline import Timeline
from runtime.transports.base import Sink
from runtime.types import Float64

__all__ = ["Tick", "TickSettings"]


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
        self._safety = safety
        self._merge = merge
        self._settings = settings
        self._actuator = Actuator(page, sink, settings, clock)
        self._report = Report(page)
        self.timeline = Timeline(page.layout.dim)
        # A restarted control goes on holding where its predecessor stood; a new one keeps silent.
        self._behaviour: Behaviour = self._holding(clock()) if self._actuator.engaged else Silent()
        self._refused = 0
        self._starved_since: float | None = None
        self._waiting = True  # for a run's first chunk: no starvation yet, the policy's deadline bounds it
        self.orphaned = False

    def __call__(self, step: int, planned: float) -> None:
        """Do the tick `step`, planned for `planned` on our clock."""
        self._observation = self._page.observation.read()
        for payload in self._page.rings["orders"].drain():
            self._obey(decode(payload), step, planned)
        self._check_estop(planned)
        self._check_family(planned)
        sent = self._send(step, planned)
        self._finish_motion(planned, sent)
        self._report.record(step, planned, self._observation, sent)
        remaining = self.timeline.remaining(step + 1)
        self._report.status(
            step, planned, self._observation, self._behaviour, self._actuator, remaining, self._refused
        )
        self._actuator.ticked(planned)

    # --- orders and chunks ---------------------------------------------------------------------------------

    def _obey(self, message: object, step: int, now: float) -> None:
        if isinstance(message, PostedChunk):
            self._merge_chunk(message, step)
        elif isinstance(message, Order):
            self._report.order, self._report.run = message.number, message.run
            if not isinstance(self._behaviour, EStopped):
                self._follow_order(message, now)

    def _follow_order(self, order: Order, now: float) -> None:
        if order.kind == "silent":
            self._actuator.engaged = False
            self._behaviour = Silent()
        elif order.kind == "hold":
            self._hold(now)
        elif order.kind == "motion" and order.goal is not None and self._engage(now):
            rate = np.full(len(order.goal), self._settings.safety.motion_acceleration)
            path = Trajectory(self._actuator.commanded, order.goal, self._settings.velocity, rate)
            self._refused = 0
            self._behaviour = Move(path, now)
        elif order.kind == "follow" and self._engage(now):
            self._refused = 0
            self._starved_since = None
            self._waiting = True
            self.timeline.clear()
            self._behaviour = Follow(order.run, self.timeline)

    def _merge_chunk(self, chunk: PostedChunk, step: int) -> None:
        if not isinstance(self._behaviour, Follow) or chunk.run != self._report.run:
            why = "control is not following that run any more"
            targets = np.full(len(chunk.rows), -1, np.int64)
            delay = step - chunk.observation_step
            self._report.merged(ChunkMerged(chunk.chunk_id, chunk.run, step, delay, targets, 0, why))
            return
        starved = self._starved_since is not None and not self._merge.waits
        if starved:
            # The plan ran out: blend the new chunk over from the target that is being held.
            held = np.repeat(self._actuator.commanded[None], len(chunk.rows), 0)
            self.timeline.replace(step, held, [()] * len(chunk.rows))
        arrival = Arrival(chunk.chunk_id, chunk.observation_step, chunk.rows)
        merged = self._merge(self.timeline, arrival, step)
        if starved and merged.dropped:
            self.timeline.clear()  # what was only laid out to be blended with is no plan
        self._waiting = False  # also where it was dropped: a policy that is always too late starves
        self._report.merged(
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

    def _measured(self, now: float) -> Float64 | None:
        """Where the robot is, None where that is not known freshly."""
        seen = self._observation
        qpos = np.array(seen["qpos"], np.float64)
        fresh = seen["sequence"] > 0 and now - seen["joints_captured"] <= self._settings.safety.joint_age_s
        return qpos if fresh and np.isfinite(qpos).all() else None

    def _engage(self, now: float) -> bool:
        """Take the robot over where it is measured; False, and said so, where nobody knows where it is."""
        if not self._actuator.engaged:
            measured = self._measured(now)
            if measured is None:
                self._report.say("unmeasured", "no fresh joints: nothing is sent to a robot unseen", now)
                return False
            self._actuator.engage(measured)
        return True

    def _hold(self, now: float) -> None:
        if self._actuator.engaged and not isinstance(self._behaviour, Hold):
            self._behaviour = self._holding(now)

    def _holding(self, now: float) -> Hold:
        # The first point is already one tick on.
        return Hold(self._actuator.brake(), now - self._actuator.elapsed(now))

    def _hold_because(self, kind: str, reason: str, now: float) -> None:
        """Hold for a reason of control's own, and say so."""
        if self._behaviour.moving:
            self._hold(now)
            self._report.say(kind, reason, now)

    def _check_estop(self, now: float) -> None:
        latched = self._page.estop is EStop.LATCHED
        if latched and not isinstance(self._behaviour, EStopped):
            # Before it was ever engaged nothing is known to send, until the robot has been measured.
            self._behaviour = EStopped(self._actuator.commanded.copy() if self._actuator.engaged else None)
            self._report.say("estopped", "e-stop", now)
        elif not latched and isinstance(self._behaviour, EStopped):
            self._behaviour = self._holding(now) if self._actuator.engaged else Silent()
            self._report.say("released", "e-stop released", now)
        if isinstance(self._behaviour, EStopped):
            measured = self._measured(now)
            if measured is not None:
                self._behaviour.position = measured
                if not self._actuator.engaged:
                    self._actuator.engage(measured)

    def _check_family(self, now: float) -> None:
        if self.orphaned:
            self._hold_because("orphaned", "the supervisor is gone", now)
            return
        for process in ("main", "guard"):
            beat = self._page.last_beat(process)
            if now - beat > self._settings.heartbeat_timeout:
                since = f"for {now - beat:.1f} s" if beat else "since it was restarted"
                self._hold_because("family", f"no sign of life from {process} {since}", now)

    def _finish_motion(self, now: float, sent: Sent) -> None:
        """A motion is done when its end has been sent: not refused, and not limited on the way there."""
        if not isinstance(self._behaviour, Move) or sent.target is None or sent.executed is None:
            return
        there = not sent.refused and np.allclose(sent.executed, sent.target.action, atol=1e-6)
        if there and self._behaviour.finished(now):
            self._behaviour = self._holding(now)
            self._report.say("motion_done", "arrived", now)

    # --- sending -------------------------------------------------------------------------------------------

    def _send(self, step: int, planned: float) -> Sent:
        target = self._behaviour.target(step, planned)
        if self._page.estop is EStop.UNKNOWN:
            return Sent(planned)
        if target is None:
            return self._starve(step, planned) if isinstance(self._behaviour, Follow) else Sent(planned)
        if target.path is None:
            return self._actuator.send(step, planned, target, target.action)
        verdict = self._safety.judge(target.action, self._state(planned), target.path)
        if verdict.action is None:
            return self._refuse(step, planned, target, verdict.notes)
        self._refused = 0
        self._recover(planned)
        return self._actuator.send(step, planned, target, verdict.action, verdict.notes)

    def _state(self, now: float) -> RobotState:
        seen = self._observation
        pictures = zip(self._page.layout.cameras, seen["picture_captured"], strict=False)
        return RobotState(
            previous=self._actuator.commanded,
            velocity=self._actuator.velocity,
            measured=np.array(seen["qpos"], np.float64),
            elapsed=self._actuator.elapsed(now),
            joint_age=now - float(seen["joints_captured"]),
            picture_ages={camera: now - float(captured) for camera, captured in pictures},
        )

    def _refuse(self, step: int, planned: float, target: Target, notes: tuple[str, ...]) -> Sent:
        self._refused += 1
        if self._refused == 1:
            self._report.say("refused", notes[-1], planned)
        if self._refused >= self._settings.safety.refusals_to_hold:
            text = f"{self._refused} actions refused in a row, the last one: {notes[-1]}"
            self._hold_because("refusals", text, planned)
        return replace(self._stand(step, planned), target=target, notes=notes, refused=True)

    def _stand(self, step: int, planned: float) -> Sent:
        """Send the next point of a stop instead of what could not be sent."""
        point = self._actuator.brake().at(self._actuator.elapsed(planned))
        return replace(self._actuator.send(step, planned, Target(point, "hold", None), point), target=None)

    def _starve(self, step: int, planned: float) -> Sent:
        if not (self._merge.waits or self._waiting):
            if self._starved_since is None:
                self._starved_since = planned
                self._report.say("starved", "no action for this step: slowing down and holding", planned)
            elif (since := planned - self._starved_since) >= self._settings.starvation_hold:
                self._hold_because("starvation", f"no usable chunk for {since:.1f} s", planned)
        return self._stand(step, planned)

    def _recover(self, now: float) -> None:
        if self._starved_since is not None:
            self._report.say("recovered", f"actions again after {now - self._starved_since:.2f} s", now)
            self._starved_since = None
