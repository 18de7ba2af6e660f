"""Binary grippers: which of its two numbers a wish means, and how soon one may switch again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robots import Robot
from runtime.core.types import Float64
from runtime.safety.limits import Limits

MIN_SWITCH_INTERVAL_S = 0.2  # between two switches of one gripper
_SAME = 1e-3  # of its travel
_ROUNDING = 1.0 - 1e-9  # an end of the travel may be the edge of the hysteresis, and must count
_EARLY_S = 1e-6  # moments are sums of floats


@dataclass(frozen=True, slots=True)
class BinaryGripper:
    """One binary gripper: its place in the robot's vector, its two numbers, and where it goes from one to the other.

    A number farther than half the `hysteresis` from the `threshold` opens or closes it, one nearer leaves it as it
    was. One at the threshold opens it where there is no hysteresis.
    """

    dim: int
    open: float
    close: float
    threshold: float
    hysteresis: float  # in the gripper's own unit

    def is_open(self, number: float) -> bool:
        """On which side of the threshold `number` is."""
        return number >= self.threshold if self.open > self.close else number <= self.threshold

    def snap(self, wanted: float, before: float) -> float:
        """`wanted` as `open` or `close`; `before` is what it was told to be until then."""
        beyond = (wanted - self.threshold) * (1.0 if self.open > self.close else -1.0)
        half = 0.5 * self.hysteresis * _ROUNDING
        opens = beyond >= half or (beyond > -half and self.is_open(before))
        return self.open if opens else self.close

    def snap_sequence(self, wanted: Float64, before: float) -> Float64:
        """The same of `wanted` [H], one after the other."""
        return np.array([before := self.snap(number, before) for number in wanted.tolist()], np.float64)


def binary_grippers_of(robot: Robot) -> tuple[BinaryGripper, ...]:
    """Those of all its binary grippers."""
    made = []
    for group in robot.groups:
        gripper, dim = group.gripper, group.gripper_dim
        if gripper is None or dim is None or gripper.threshold is None or gripper.hysteresis is None:
            continue
        width = gripper.hysteresis * abs(gripper.open - gripper.close)
        made.append(BinaryGripper(dim, gripper.open, gripper.close, gripper.threshold, width))
    return tuple(made)


def snap_grippers(switches: tuple[BinaryGripper, ...], action: Float64, commanded: Float64) -> Float64:
    """`action` [D] with every binary gripper open or closed, after it was `commanded` [D]; what is no number stays."""
    if action.shape != commanded.shape:
        return action
    numbers = [switch for switch in switches if np.isfinite(action[switch.dim])]
    ends = {one.dim: one.snap(action[one.dim], commanded[one.dim]) for one in numbers}
    if all(action[dim] == end for dim, end in ends.items()):
        return action
    action = action.copy()
    action[list(ends)] = list(ends.values())
    return action


class Dwell:
    """Keeps each binary gripper of one robot from switching again within DWELL_S, whoever wants it to."""

    def __init__(self, limits: Limits) -> None:
        self._names = limits.names
        self._binary = limits.binary
        self._same = _SAME * (limits.upper - limits.lower)
        self._switched = np.full(len(limits.binary), -np.inf)  # when [s]

    def apply(self, action: Float64, commanded: Float64, now: float) -> tuple[Float64, tuple[str, ...]]:
        """`action` [D] with grippers that would switch too soon where they are `commanded` [D], and notes on these."""
        early = now - self._switched < MIN_SWITCH_INTERVAL_S - _EARLY_S
        if not early.any() or action.shape != commanded.shape:
            return action, ()
        kept = early & self._switches(action, commanded)
        if not kept.any():
            return action, ()
        notes = tuple(
            f"{self._names[i]} kept at {round(float(commanded[i]), 4):g}: it switches once per "
            f"{MIN_SWITCH_INTERVAL_S:g} s at most"
            for i in np.flatnonzero(kept)
        )
        return np.where(kept, commanded, action), notes

    def record_command(self, before: Float64, now_sent: Float64, now: float) -> None:
        """The robot was told `now_sent` [D] after `before` [D]."""
        self._switched[self._switches(now_sent, before)] = now

    def _switches(self, action: Float64, before: Float64) -> np.ndarray:
        return np.asarray(self._binary & (np.abs(action - before) > self._same))
