"""Safety filter: checks and limits every action before it is sent."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from runtime.core.sentences import Pattern
from runtime.core.types import Float64
from runtime.motion.trajectories import Brake
from runtime.safety.collision import Collision, Collisions
from runtime.safety.limits import Limits
from runtime.safety.settings import SafetySettings, WorkspaceBox

_JOINTS_OLD = Pattern("safety.joints_old", "joint readings are {seconds:.2f} s old (limit {allowed:g} s)")
_PICTURE_OLD = Pattern("safety.picture_old", "picture {camera} is {seconds:.2f} s old (limit {allowed:g} s)")
_LEAVES_WORKSPACE = Pattern("safety.leaves_workspace", "{arms} would leave the workspace box")
_AWAY_FROM_MEASURED = Pattern(
    "safety.away_from_measured",
    "{joint} would be {distance:.2f} rad from where it is measured, allowed {allowed:g}",
)
_JUMPS = Pattern("safety.jumps", "{joint} jumps {distance:.2f} rad, allowed {allowed:g}")
_LIMITED = Pattern("safety.limited", "{joint} limited from {wanted:.4f} to {reachable:.4f}")
_OUTSIDE = Pattern("safety.outside", "{joint} {value:.4f} is outside {lower:g}..{upper:g}")
_SHAPE = Pattern("safety.shape", "action has shape {given}, expected {expected}")

__all__ = [
    "Limits",
    "Path",
    "RobotState",
    "SafetyFilter",
    "SafetySettings",
    "SafetyVerdict",
    "WorkspaceBox",
]

_TOLERANCE = 1e-6
_BOX_STEP, _BOX_POINTS = 0.005, 48  # [rad] path sampling: deviation between samples is micrometres
_COLLISION_STEP, _COLLISION_POINTS = 0.1, 4
_MARGIN = 1.05


@dataclass(frozen=True, slots=True)
class RobotState:
    """State against which an action is checked: vectors float64 [D], times in seconds."""

    previous: Float64  # last command sent
    velocity: Float64  # of the commands
    measured: Float64
    elapsed: float  # since the last command; the caller caps it at 1.5 periods
    joint_age: float = 0.0
    implausible_reason: str = ""  # why `measured` cannot be true, "" if it can
    picture_ages: dict[str, float] = field(default_factory=dict)
    previous_target: Float64 | None = None  # action requested at the previous tick; None: use `previous`


@dataclass(frozen=True, slots=True)
class SafetyVerdict:
    """Result of the checks: `action` float64 [D] may be sent, or is None if refused.

    `notes` are the changes, or the reason of the refusal. `largest_change_note` describes the dimension that was
    changed most, and `change` is the size of its change in rad. For a gripper the size is scaled by
    `Limits.radian_scale`. `near_collision` is a pair of links that the action brings near each other, if the settings
    only warn of that.
    """

    action: Float64 | None
    notes: tuple[str, ...] = ()
    largest_change_note: str = ""
    change: float = 0.0
    near_collision: Collision | None = None

    @property
    def refused(self) -> bool:
        return self.action is None


Path = Literal["policy", "motion"]


class SafetyFilter:
    """Filter that checks actions in a fixed order.

    The order: finite, ages, workspace, collision, following error, jump, reachability, limits. Reachability makes the
    command satisfy velocity, acceleration and joint limits in one step: the velocity is bounded so that the joint can
    still stop before its limit with the same acceleration, also if tick lengths vary (v dt + v^2 / 2a <= distance), so
    that no limit contradicts another.
    """

    def __init__(
        self,
        settings: SafetySettings,
        limits: Limits,
        outside: Callable[[Float64], tuple[str, ...]] | None = None,
        collisions: Collisions | None = None,
    ) -> None:
        self._settings = settings
        self._limits = limits
        self._outside = outside  # returns the arms that are outside their box anywhere in q [..., D]
        self._collisions = collisions
        self._angles = limits.position_mask
        self._switching = bool(limits.binary.any())
        self._reach = limits.radian_scale
        self._room = np.zeros((2, len(limits.lower)))  # scratch: distance to the upper, from the lower limit
        self._stopping = settings.acceleration * self._reach
        self._top = {
            "policy": limits.velocity * settings.velocity_scale,
            # A motion is planned at its limits; the margin prevents that rounding counts as excess.
            "motion": limits.velocity * settings.motion_velocity_scale * _MARGIN,
        }
        self._rate = {
            "policy": self._stopping,
            "motion": settings.motion_acceleration * self._reach * _MARGIN,
        }

    def judge(self, action: Float64, state: RobotState, path: Path = "policy") -> SafetyVerdict:
        """Check and limit `action` [D]; return the verdict.

        `path` selects the limits: "policy" for a policy's actions, "motion" for generated motions such as homing. With
        `report_only` the action is not changed; the verdict has notes on what would have been refused or changed.
        """
        if not _usable(action, state):
            return SafetyVerdict(None, (_unusable(action, self._limits),))
        refusal = self._refusal(action, state, path)
        if refusal and not self._settings.report_only:
            return SafetyVerdict(None, (refusal,))
        reachable = self.reachable(action, state, path)
        notes = self._changes(action, reachable)
        if self._settings.report_only:
            return self._warned(
                SafetyVerdict(action, (*filter(None, [refusal]), *notes, *self._excess(action))), path
            )
        violation = self._violation(reachable, state) or self._arrival(action, reachable, state, path)
        if violation:
            return SafetyVerdict(None, (*notes, violation))
        return self._warned(
            self._changed(action, reachable, notes) if notes else SafetyVerdict(reachable), path
        )

    def _refusal(self, action: Float64, state: RobotState, path: Path) -> str:
        blind = self.unknown_state_reason(state)
        if path == "motion":  # a generated motion needs no pictures
            return blind or self._place(action, state, path) or self._exceeds_following_error(action, state)
        return (
            blind
            or self._stale(state)
            or self._place(action, state, path)
            or self._exceeds_following_error(action, state)
            or self._jumps(action, state)
        )

    def unknown_state_reason(self, state: RobotState) -> str:
        """Return why the robot's position is unknown, "" if it is known."""
        return state.implausible_reason or self.unseen(state)

    def unseen(self, state: RobotState) -> str:
        """Return a message if the last plausible joint readings are too old, else ""."""
        allowed = self._settings.joint_age_s
        if state.implausible_reason or state.joint_age <= allowed:
            return ""
        return _JOINTS_OLD(seconds=state.joint_age, allowed=allowed)

    def _stale(self, state: RobotState) -> str:
        allowed = self._settings.picture_age_s
        for camera, age in state.picture_ages.items():
            if not age <= allowed:  # also refuses NaN: no picture was ever received
                return _PICTURE_OLD(camera=camera, seconds=age, allowed=allowed)
        return ""

    def _place(self, action: Float64, state: RobotState, path: Path) -> str:
        """Return why the position `action` is forbidden (outside a box, in collision), "" if it is allowed."""
        return self._leaves_box(action, state, path) or self._collides(action, state, path)

    def _leaves_box(self, action: Float64, state: RobotState, path: Path) -> str:
        """Return a message that names the arms outside their box, "" if there is none.

        A policy's action must be inside; a motion may start outside, and only arms that would leave their box count.
        """
        arms = self._outside(action) if self._outside else ()
        if arms and self._outside and path == "motion":
            before = self._outside(state.previous)
            arms = tuple(arm for arm in arms if arm not in before)
        return _LEAVES_WORKSPACE(arms=", ".join(arms)) if arms else ""

    def _collides(self, action: Float64, state: RobotState, path: Path) -> str:
        if self._collisions is None or (path == "policy" and self._settings.collision != "refuse"):
            return ""
        pair = self._collisions.closer_pair(action, state.previous)
        return "" if pair is None else str(pair)

    def _warned(self, verdict: SafetyVerdict, path: Path) -> SafetyVerdict:
        """Return `verdict`, with a warning added if the action brings two links near each other.

        This is done only for a policy's actions, and only if the settings demand warnings of collisions instead of
        refusals.
        """
        if self._collisions is None or path == "motion" or self._settings.collision != "warn":
            return verdict
        assert verdict.action is not None
        near = self._collisions.nearest(verdict.action)
        return (
            verdict
            if near is None
            else replace(verdict, notes=(*verdict.notes, str(near)), near_collision=near)
        )

    def _exceeds_following_error(self, action: Float64, state: RobotState) -> str:
        allowed = self._settings.following_error
        error = np.abs(action - state.measured)
        if ((error <= allowed) | ~self._angles).all():  # NaN (an unmeasured joint) compares as False
            return ""
        error = np.where(self._angles, error, 0.0)
        # A blocked arm must still be allowed to return towards its measured position.
        returning = error < np.abs(state.previous - state.measured)
        excess = np.where(returning | (error <= allowed), 0.0, error)
        if not excess.any():
            return ""
        worst = int(excess.argmax())
        name = self._limits.names[worst]
        return _AWAY_FROM_MEASURED(joint=name, distance=excess[worst], allowed=allowed)

    def _jumps(self, action: Float64, state: RobotState) -> str:
        jump = np.where(self._angles, np.abs(action - state.previous), 0.0)
        worst = int(jump.argmax())
        if jump[worst] <= self._settings.jump:
            return ""
        return _JUMPS(joint=self._limits.names[worst], distance=jump[worst], allowed=self._settings.jump)

    def _arrival(self, action: Float64, reachable: Float64, state: RobotState, path: Path) -> str:
        """Return why the command that will be sent, or the path on which it would brake, is forbidden; "" if both are
        allowed.
        """
        if self._outside is None and self._collisions is None:
            return ""
        velocity = (reachable - state.previous) / state.elapsed
        brake = braking(reachable, velocity, self._limits, self._settings)
        changed = reachable is not action  # an unchanged action has been checked already
        return (self._place(reachable, state, path) if changed else "") or self._path_problem(
            brake, state, path
        )

    def _path_problem(self, brake: Brake, state: RobotState, path: Path) -> str:
        """Return why the braking path is forbidden, "" if it is allowed.

        The path is sampled: finely for boxes, coarsely for collisions.
        """
        if self._outside is not None:
            left = self._leaves_box(brake.sample_path(_BOX_STEP, _BOX_POINTS), state, path)
            if left:
                return left
        ends = brake.sample_path(_COLLISION_STEP, _COLLISION_POINTS)
        return next(filter(None, (self._collides(point, state, path) for point in ends)), "")

    def reachable(self, action: Float64, state: RobotState, path: Path = "policy") -> Float64:
        """Return the action closest to `action` [D] within velocity, acceleration and joint limits.

        If nothing has to change, it is the same array.
        """
        dt, now = state.elapsed, state.velocity
        gain = self._rate[path] * dt
        room = self._room
        np.subtract(self._limits.upper, state.previous, out=room[0])
        np.subtract(state.previous, self._limits.lower, out=room[1])
        most = np.minimum(self._top[path], _stopping_speed(room, self._stopping, dt))
        fastest = np.minimum(most[0], now + gain)
        slowest = np.maximum(-most[1], now - gain)
        crossed = slowest > fastest
        if crossed.any():
            # The joint limit is too near for this path's own deceleration (the limit was changed, or a tick was
            # late): stop before it, with up to the hardest deceleration that any path may use.
            hard = self._stopping * dt
            stops = np.where(now > 0, most[0], -most[1])
            braking = np.minimum(np.maximum(stops, now - hard), now + hard)
            fastest, slowest = np.where(crossed, braking, fastest), np.where(crossed, braking, slowest)
        requested = (action - state.previous) / dt
        velocity = np.minimum(
            np.maximum(self._catch_up_velocity(requested, action, state, path), slowest), fastest
        )
        changed = np.abs(velocity - requested) * dt > _TOLERANCE
        if self._switching:
            changed &= ~self._limits.binary
        reachable = np.where(changed, state.previous + velocity * dt, action) if changed.any() else action
        if self._switching:
            within = np.clip(action, self._limits.lower, self._limits.upper)
            reachable = np.where(self._limits.binary, within, reachable)
        return reachable

    def _catch_up_velocity(
        self, requested: Float64, action: Float64, state: RobotState, path: Path
    ) -> Float64:
        """Return the `requested` velocities, reduced for joints that lag behind their target.

        After a jump of the target, the command must not arrive with all the speed gathered on the way: its speed
        relative to the target is limited to one that can still be braked within the remaining distance.
        """
        aim = state.previous if state.previous_target is None else state.previous_target
        behind = aim - state.previous
        if not (np.abs(behind) > _TOLERANCE).any():
            return requested
        dt = state.elapsed
        own = (action - aim) / dt
        speed = _stopping_speed(np.abs(behind), self._rate[path], dt)
        bounded = own + np.minimum(np.maximum(requested - own, -speed), speed)
        return np.where(np.abs(behind) > _TOLERANCE, bounded, requested)

    def _changes(self, action: Float64, reachable: Float64) -> tuple[str, ...]:
        if reachable is action:
            return ()
        return tuple(
            self._change(i, action, reachable)
            for i in np.flatnonzero(np.abs(reachable - action) > _TOLERANCE)
        )

    def _change(self, i: int | np.intp, action: Float64, reachable: Float64) -> str:
        return _LIMITED(joint=self._limits.names[i], wanted=action[i], reachable=reachable[i])

    def _changed(self, action: Float64, reachable: Float64, notes: tuple[str, ...]) -> SafetyVerdict:
        change = np.abs(reachable - action) / self._reach
        worst = change.argmax()
        return SafetyVerdict(reachable, notes, self._change(worst, action, reachable), float(change[worst]))

    def _violation(self, action: Float64, state: RobotState) -> str:
        limits = self._limits
        excess = limits.excess(action)
        if not (excess > _TOLERANCE).any():
            return ""
        worse = (excess > _TOLERANCE) & (excess > limits.excess(state.previous) + _TOLERANCE)
        if not worse.any():
            return ""
        i = int(np.flatnonzero(worse)[0])
        return _OUTSIDE(joint=limits.names[i], value=action[i], lower=limits.lower[i], upper=limits.upper[i])

    def _excess(self, action: Float64) -> tuple[str, ...]:
        limits = self._limits
        return tuple(
            _OUTSIDE(joint=limits.names[i], value=action[i], lower=limits.lower[i], upper=limits.upper[i])
            for i in np.flatnonzero(limits.excess(action) > _TOLERANCE)
        )


def braking(position: Float64, velocity: Float64, limits: Limits, settings: SafetySettings) -> Brake:
    """Return a braking motion from `position` at `velocity` [D], as hard as necessary to stay within the joint limits.

    Its deceleration is between `brake_acceleration` and `acceleration` of `settings`, scaled for grippers.
    """
    ahead = np.where(velocity > 0, limits.upper - position, position - limits.lower)
    needed = velocity * velocity / (2.0 * np.maximum(ahead, 1e-9))
    softest = settings.brake_acceleration * limits.radian_scale
    rate = np.clip(needed, softest, np.maximum(softest, settings.acceleration * limits.radian_scale))
    return Brake(
        position.copy(), velocity.copy(), rate, limits.lower, limits.upper, limits.speeds, limits.velocity
    )


def _usable(action: Float64, state: RobotState) -> bool:
    return action.shape == state.previous.shape and bool(np.isfinite(action).all())


def _unusable(action: Float64, limits: Limits) -> str:
    if action.shape != limits.lower.shape:
        return _SHAPE(given=action.shape, expected=limits.lower.shape)
    i = int(np.flatnonzero(~np.isfinite(action))[0])
    return f"{limits.names[i]} is {action[i]}"


def _stopping_speed(distance: Float64, acceleration: Float64, dt: float) -> Float64:
    """Return the largest v with v dt + v^2 / (2 a) <= distance, at which the joint can still stop after this step."""
    d = np.maximum(distance, 0.0)
    return np.asarray(acceleration * (np.sqrt(dt * dt + 2.0 * d / acceleration) - dt))
