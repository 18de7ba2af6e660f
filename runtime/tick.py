"""One control tick: obey orders, merge chunks, choose a target, judge it, send it, write it down."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from runtime.actuator import Actuator, Sent, TickSettings
from runtime.behaviour import Behaviour, EStopped, Follow, Hold, Move, Silent, Target
from runtime.messages import ChunkMerged, NodeRequest, Order, PostedChunk, decode
from runtime.motion import Trajectory
from runtime.page import EStop, Page
from runtime.report import Report
from runtime.safety import RobotState, SafetyFilter
from runtime.strategies.base import Arrival, Merge
from runtime.timeline import Timeline
from runtime.transports.base import Sink
from runtime.types import Float64

__all__ = ["Tick", "TickSettings"]
_UNSEEN_S = 0.5  # without joints: whatever has happened to the robot meanwhile was not seen
_RETURNED_AWAY = 0.1  # [rad] that an arm may be off after that, by sagging
_ARRIVED = 1e-4  # [rad] of a motion's end: it may have been limited on its last steps
_JOINED_AT_ONCE = 0.05  # [rad] that a run's first action may be off without being blended in


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
        self._behaviour: Behaviour = self._holding() if self._actuator.engaged else Silent()
        self._standing: Hold | None = None  # a stop in place of what could not be sent
        self._refused = 0
        # Refusals among the last actions: every second one refused is as bad as all of them.
        self._verdicts: deque[bool] = deque(maxlen=2 * settings.safety.refusals_to_hold)
        self._unseen_since: float | None = None
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
        self._check_displaced(planned)
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
        elif isinstance(message, NodeRequest):
            refusal = self._actuator.tell(message.word, message.data)
            if refusal:
                self._report.say("word_refused", refusal, now)
        elif isinstance(message, Order):
            self._report.order, self._report.run = message.number, message.run
            if not isinstance(self._behaviour, EStopped):
                self._follow_order(message, now)

    def _follow_order(self, order: Order, now: float) -> None:
        if order.kind != "hold":
            self._standing = None
        if order.kind == "silent":
            self._actuator.engaged = False
            self._behaviour = Silent()
        elif order.kind == "hold":
            self._hold(now)
        elif order.kind == "motion" and order.goal is not None and self._engage(now):
            self._forget_refusals()
            self._move(order.goal)
        elif order.kind == "follow" and self._engage(now):
            self._forget_refusals()
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
        held_before = (self._starved_since is not None or self._far(chunk.rows[0])) and not self._merge.waits
        if held_before:
            # Nothing was planned: blend the new chunk over from the target that is being held.
            held = np.repeat(self._actuator.commanded[None], len(chunk.rows), 0)
            self.timeline.replace(step, held, [()] * len(chunk.rows))
        arrival = Arrival(chunk.chunk_id, chunk.observation_step, chunk.rows)
        merged = self._merge(self.timeline, arrival, step)
        if held_before and merged.dropped:
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

    def _far(self, row: Float64) -> bool:
        """Whether a run's first chunk begins too far from where the robot is held to be joined at once."""
        if not self._waiting or self._settings.safety.report_only:
            return False
        away = np.abs(row - self._actuator.commanded)
        return bool(np.where(self._settings.grippers, 0.0, away).max() > _JOINED_AT_ONCE)

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
            self._behaviour = self._standing or self._holding()

    def _holding(self) -> Hold:
        return Hold(self._actuator.brake())

    def _move(self, goal: Float64) -> None:
        """Come to a stand, then go to `goal`."""
        brake = self._actuator.brake()
        rate = self._settings.safety.motion_acceleration * self._settings.reach
        path = Trajectory(brake.at(brake.duration), goal, self._settings.velocity, rate)
        self._behaviour = Move(brake, path, goal)

    def _forget_refusals(self) -> None:
        self._refused = 0
        self._verdicts.clear()

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
            self._behaviour = self._holding() if self._actuator.engaged else Silent()
            self._report.say("released", "e-stop released", now)
        if isinstance(self._behaviour, EStopped):
            measured = self._measured(now)
            if measured is not None:
                if not self._actuator.engaged:
                    self._actuator.engage(measured)
                # An object in the gripper keeps it open: its command stays, or it would let go.
                seen = np.where(self._settings.grippers, self._actuator.commanded, measured)
                self._behaviour.see(seen, self._settings.safety.following_error)

    def _check_displaced(self, now: float) -> None:
        """Hold where the robot is, and not where it was told to hold, once these are far apart.

        It was moved by hand, switched off, or its node was restarted: to send the old target would make it move
        by itself.
        """
        measured = self._measured(now)
        if measured is None:
            self._unseen_since = now if self._unseen_since is None else self._unseen_since
            return
        returned = self._unseen_since is not None and now - self._unseen_since > _UNSEEN_S
        self._unseen_since = None
        held = isinstance(self._behaviour, Hold) and self._actuator.engaged
        if not held or self._settings.safety.report_only:
            return
        away = np.where(self._settings.grippers, 0.0, np.abs(measured - self._actuator.commanded))
        allowed = _RETURNED_AWAY if returned else self._settings.safety.following_error
        if away.max() > allowed:
            self._actuator.engage(measured)
            self._behaviour = self._holding()
            text = f"the robot is {away.max():.2f} rad from where it was told to hold: holding where it is"
            self._report.say("displaced", text, now)

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
        if sent.refused:
            self._move(self._behaviour.goal)  # from where it stands, when it may go on
            return
        self._behaviour.sent()
        if self._behaviour.finished and np.allclose(sent.executed, self._behaviour.goal, atol=_ARRIVED):
            self._behaviour = self._holding()
            self._report.say("motion_done", "arrived", now)

    # --- sending -------------------------------------------------------------------------------------------

    def _send(self, step: int, planned: float) -> Sent:
        target = self._behaviour.target(step, self._actuator.elapsed(planned))
        if self._page.estop is EStop.UNKNOWN:
            return Sent(planned)
        if target is None:
            return self._starve(step, planned) if isinstance(self._behaviour, Follow) else Sent(planned)
        if target.path is None:
            self._standing = None  # what is sent now is another stop: the old one must not go on later
            return self._actuator.send(step, planned, target, target.action)
        verdict = self._safety.judge(target.action, self._state(planned), target.path)
        if verdict.action is None:
            return self._refuse(step, planned, target, verdict.notes)
        self._refused = 0
        self._verdicts.append(False)
        self._standing = None
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
        self._verdicts.append(True)
        if self._refused == 1:
            self._report.say("refused", notes[-1], planned)
        refused = sum(self._verdicts)
        if refused >= self._settings.safety.refusals_to_hold:
            how = "in a row" if refused == self._refused else f"of the last {len(self._verdicts)}"
            text = f"{refused} actions refused {how}, the last one: {notes[-1]}"
            self._hold_because("refusals", text, planned)
        return replace(self._stand(step, planned), target=target, notes=notes, refused=True)

    def _stand(self, step: int, planned: float) -> Sent:
        """Send the next point of a stop instead of what could not be sent."""
        if self._standing is None:
            self._standing = self._holding()
        target = self._standing.target(step, self._actuator.elapsed(planned))
        assert target is not None
        return replace(self._actuator.send(step, planned, target, target.action), target=None)

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
