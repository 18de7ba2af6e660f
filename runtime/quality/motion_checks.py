"""Checks of motion: idle time at start and end, joints at their limits, joints that do not follow commands."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from runtime.core.types import Float32, Float64
from runtime.quality.block import Block, Bools, EpisodeSource, JointSpecs
from runtime.quality.report import Flag, FlagCollector, FrameRun, RunCollector, frame_range
from runtime.quality.settings import QualitySettings


class MotionCheck:
    """Check of state and action, block by block; `add` returns the rows in which the robot moves."""

    def __init__(
        self, source: EpisodeSource, joints: JointSpecs, settings: QualitySettings, flags: FlagCollector
    ) -> None:
        self._fps = source.fps
        self._joints = joints
        self._settings = settings
        self._flags = flags
        roles = {vector.role: name for name, vector in source.vectors.items()}
        self._state, self._action = roles["state"], roles.get("action", "")
        if self._action and source.vectors[self._action].width != len(joints.names):
            flags.unchecked.append(
                f"limits and following are not checked: {self._action} has another width than {self._state}"
            )
            self._action = ""
        self._still = _idle_speeds(joints, settings)
        lag = max(1, round(settings.motion_lag_s * self._fps))
        self._lag = lag
        self._past = np.empty((0, len(joints.names)), np.float32)  # the last `lag` rows
        self._first_motion = self._last_motion = -1
        self._rows = 0
        self._members = {
            group: np.array([name == group for name in joints.groups])
            for group in dict.fromkeys(joints.groups)
        }
        ranges = joints.upper - joints.lower
        self._away = np.zeros(
            len(joints.names), np.bool_
        )  # whether a joint has been commanded away from its limits
        self._margin = np.where(np.isfinite(ranges), ranges, np.nan) * settings.limit_margin
        self._at_limit = [RunCollector(self._saturated(dim)) for dim in range(len(joints.names))]
        self._outside = [RunCollector(self._beyond(dim)) for dim in range(len(joints.names))]
        self._following = _TrackingDelay(
            round(settings.tracking_s * self._fps), joints, settings, flags, self._action
        )

    @property
    def lag_s(self) -> float | None:
        """Delay of the state after the action [s]; None if it cannot be determined."""
        lag = self._following.lag
        return None if lag is None else lag / self._fps

    def add(self, block: Block) -> Bools:
        """Check the next rows; return for each whether the robot moves in it, bool [N]."""
        state = _usable(block, self._state)
        moving = self._moving(state)
        some: Bools = np.asarray(moving.any(axis=1))
        moving_rows = np.flatnonzero(some)
        if len(moving_rows):
            self._first_motion = (
                self._first_motion if self._first_motion >= 0 else block.first + int(moving_rows[0])
            )
            self._last_motion = block.first + int(moving_rows[-1])
        self._rows = block.first + block.rows
        with np.errstate(invalid="ignore"):
            self._beyond_limits(block.first, state)
            if self._action:
                action = _usable(block, self._action)
                self._limits(block.first, action, moving)
                real = np.ones(block.rows, np.bool_) if block.simulated is None else ~block.simulated
                self._following.add(
                    block.first, np.where(real[:, None], action, np.nan).astype(np.float32), state
                )
        return some

    def _moving(self, state: Float32) -> Bools:
        """Return which dimensions moved, bool [N, D]: their state differs from that `lag` rows before.

        Near the start of the episode it is compared with the first row.
        """
        rows = np.concatenate([self._past, state])
        places = np.arange(len(self._past), len(rows))
        before = np.maximum(places - self._lag, 0)
        away = np.abs(rows[places] - rows[before])
        self._past = rows[-self._lag :]
        bound = self._still * (self._lag / self._fps)
        moving: Bools = np.greater(np.nan_to_num(away), bound)
        return moving

    def _limits(self, first: int, action: Float32, moving: Bools) -> None:
        joints = self._joints
        near = (action <= joints.lower + self._margin) | (action >= joints.upper - self._margin)
        # A joint that has been at its limit since the start belongs there.
        came = np.logical_or.accumulate(np.concatenate([self._away[None], np.isfinite(action) & ~near]))
        self._away = came[-1]
        near &= came[1:]
        for members in self._members.values():
            stirring = moving[:, members].any(axis=1)
            for dim in np.flatnonzero(members & joints.position_mask):
                self._at_limit[dim].add(first, near[:, dim] & stirring)

    def _beyond_limits(self, first: int, state: Float32) -> None:
        joints = self._joints
        excess = np.maximum(joints.lower - state, state - joints.upper)
        for dim in np.flatnonzero(joints.position_mask):
            marked = excess[:, dim] > self._settings.limit_excess
            self._outside[dim].add(first, marked, np.nan_to_num(excess[:, dim]))

    def close(self) -> None:
        """End the checks."""
        for runs in (*self._at_limit, *self._outside):
            runs.close()
        self._following.close()
        if self._rows:
            self._idle()

    def _idle(self) -> None:
        last = self._rows - 1
        if self._first_motion < 0:
            text = f"{frame_range(0, last)}: the robot never moves"
            self._flags.add(Flag("idle", "error", 0, last, self._state, text, self._rows / self._fps, None))
            return
        # Motion is detected as soon as positions differ, at most the lag after it began.
        head, tail = self._first_motion, last - self._last_motion
        for kind, frames, first, bound, phase in (
            ("idle_head", head, 0, self._settings.idle_head_s, "before it moves"),
            ("idle_tail", tail, last - tail + 1, self._settings.idle_tail_s, "after it moved"),
        ):
            seconds = frames / self._fps
            if seconds > bound:
                end = first + frames - 1
                text = f"{frame_range(first, end)}: the robot stands for {seconds:.1f} s {phase}"
                self._flags.add(Flag(kind, "warning", first, end, self._state, text, seconds, bound))

    def _saturated(self, dim: int) -> Callable[[FrameRun], None]:
        def ended(run: FrameRun) -> None:
            seconds = run.frames / self._fps
            if seconds > self._settings.saturation_s:
                name = self._joints.names[dim]
                where = frame_range(run.first, run.last)
                text = f"{where}: {name} is commanded to its limit for {seconds:.1f} s with its group moving"
                bound = self._settings.saturation_s
                self._flags.add(
                    Flag("saturation", "warning", run.first, run.last, self._action, text, seconds, bound)
                )

        return ended

    def _beyond(self, dim: int) -> Callable[[FrameRun], None]:
        def ended(run: FrameRun) -> None:
            name = self._joints.names[dim]
            text = f"{frame_range(run.first, run.last)}: {name} is measured {run.value:.3f} beyond its limit"
            bound = self._settings.limit_excess
            self._flags.add(
                Flag("outside_limits", "warning", run.first, run.last, self._state, text, run.value, bound)
            )

        return ended


class _TrackingDelay:
    """Errors between action and measured state for assumed delays of 0 to `wait` rows.

    The delay with the smallest error is the robot's delay.
    """

    def __init__(
        self, wait: int, joints: JointSpecs, settings: QualitySettings, flags: FlagCollector, stream: str
    ) -> None:
        self._wait = max(0, wait)
        self._joints = joints
        self._settings = settings
        self._flags = flags
        self._stream = stream
        self._judged = joints.position_mask
        self._actions = np.empty((0, len(joints.names)), np.float32)  # rows whose waiting time has not passed
        self._states = np.empty((0, len(joints.names)), np.float32)
        self._runs = RunCollector(self._ended, apart=self._wait)
        self._worst: dict[int, int] = {}
        self._sums: Float64 = np.zeros(self._wait + 1)
        self._counted = 0
        self._moved = False

    @property
    def lag(self) -> int | None:
        """Delay at which state and action are nearest [rows]; None if nothing moved or nothing was checked."""
        return int(np.argmin(self._sums)) if self._counted and self._moved else None

    def add(self, first: int, action: Float32, state: Float32) -> None:
        pending = len(self._actions)
        actions = np.concatenate([self._actions, action])
        states = np.concatenate([self._states, state])
        whole = len(actions) - self._wait  # the last rows lack later states: checked with the next block
        if whole <= 0:
            self._actions, self._states = actions, states
            return
        at = np.arange(whole)
        errors = np.stack([np.abs(actions[:whole] - states[at + lag]) for lag in range(self._wait + 1)])
        self._count(errors, actions[:whole])
        nearest = np.where(np.isfinite(errors), errors, np.inf).min(axis=0)
        nearest[~np.isfinite(nearest)] = 0.0
        nearest[:, ~self._judged] = 0.0
        worst = nearest.max(axis=1, initial=0.0)
        start = first - pending
        for row in np.flatnonzero(worst > self._settings.tracking_error):
            self._worst[start + int(row)] = int(np.argmax(nearest[row]))
        self._runs.add(start, worst > self._settings.tracking_error, worst)
        self._actions, self._states = actions[whole:], states[whole:]

    def _count(self, errors: Float32, actions: Float32) -> None:
        judged = errors[:, :, self._judged]
        rows = np.isfinite(judged).all(axis=(0, 2))
        if rows.any() and judged.shape[2]:
            self._sums += judged[:, rows].sum(axis=(1, 2), dtype=np.float64)
            self._counted += int(rows.sum())
            travelled = np.ptp(actions[rows][:, self._judged], axis=0)
            self._moved = self._moved or bool((travelled > self._settings.tracking_error).any())

    def _ended(self, run: FrameRun) -> None:
        dim = self._worst[run.at]
        self._worst = {frame: run_at for frame, run_at in self._worst.items() if frame > run.last}
        text = (
            f"{frame_range(run.first, run.last)}: {self._joints.names[dim]} stays {run.value:.3f} away from what was "
            f"commanded, {self._settings.tracking_s:g} s long"
        )
        bound = self._settings.tracking_error
        self._flags.add(
            Flag("tracking", "warning", run.first, run.last, self._stream, text, run.value, bound)
        )

    def close(self) -> None:
        self._runs.close()


def _usable(block: Block, name: str) -> Float32:
    """Return the column `name` as an array, NaN for unknown values."""
    numbers = block.vectors[name]
    valid = ~(numbers.missing | numbers.malformed)
    return np.where(valid[:, None] & np.isfinite(numbers.values), numbers.values, np.nan).astype(np.float32)


def _idle_speeds(joints: JointSpecs, settings: QualitySettings) -> Float64:
    """Return the speed of each dimension [D] up to which it counts as idle."""
    travel = joints.upper - joints.lower
    travel = np.where(np.isfinite(travel) & (travel > 0), travel, 1.0)
    return np.where(joints.grippers, settings.idle_gripper * travel, settings.idle_speed)
