"""Binary grippers: snapping of numbers to open or closed, and the shortest time between two switches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robots import Robot
from runtime.core.types import Float64
from runtime.safety.limits import Limits

MIN_SWITCH_INTERVAL_S = 0.2  # [s] between two switches of one gripper
_SAME = 1e-3  # share of the gripper's travel
_ROUNDING = 1.0 - 1e-9  # an end of the travel may coincide with the edge of the hysteresis, and must count
_EARLY_S = 1e-6  # [s] rounding tolerance of summed times


@dataclass(frozen=True, slots=True)
class BinaryGripper:
    """Binary gripper: its index in the robot's vector, its two values, its threshold and hysteresis.

    A number farther than half the `hysteresis` from the `threshold` opens or closes the gripper; a nearer number does
    not switch it. Without hysteresis a number at the threshold opens it.
    """

    dim: int
    open: float
    close: float
    threshold: float
    hysteresis: float  # in the gripper's own unit

    def is_open(self, number: float) -> bool:
        """Return True if `number` is on the open side of the threshold."""
        return number >= self.threshold if self.open > self.close else number <= self.threshold

    def snap(self, wanted: float, before: float) -> float:
        """Return the open or closed value for the number `wanted`, with hysteresis; `before` is the previous
        command.
        """
        beyond = (wanted - self.threshold) * (1.0 if self.open > self.close else -1.0)
        half = 0.5 * self.hysteresis * _ROUNDING
        opens = beyond >= half or (beyond > -half and self.is_open(before))
        return self.open if opens else self.close

    def snap_sequence(self, wanted: Float64, before: float) -> Float64:
        """Return the open or closed values for the numbers `wanted` [H], with hysteresis.

        `before` is the command before the first number; each result is the previous command for the next number.
        """
        return np.array([before := self.snap(number, before) for number in wanted.tolist()], np.float64)


def binary_grippers_of(robot: Robot) -> tuple[BinaryGripper, ...]:
    """Return the binary grippers of a robot."""
    grippers = []
    for group in robot.groups:
        gripper, dim = group.gripper, group.gripper_dim
        if gripper is None or dim is None or gripper.threshold is None or gripper.hysteresis is None:
            continue
        width = gripper.hysteresis * abs(gripper.open - gripper.close)
        grippers.append(BinaryGripper(dim, gripper.open, gripper.close, gripper.threshold, width))
    return tuple(grippers)


def snap_grippers(switches: tuple[BinaryGripper, ...], action: Float64, commanded: Float64) -> Float64:
    """Return `action` [D] with every binary gripper snapped; `commanded` [D] is the previous command.

    Numbers that are not finite are not changed, nor is an action of another shape.
    """
    if action.shape != commanded.shape:
        return action
    numbers = [switch for switch in switches if np.isfinite(action[switch.dim])]
    ends = {number.dim: number.snap(action[number.dim], commanded[number.dim]) for number in numbers}
    if all(action[dim] == end for dim, end in ends.items()):
        return action
    action = action.copy()
    action[list(ends)] = list(ends.values())
    return action


class Dwell:
    """Limit on switches of binary grippers: each is held for MIN_SWITCH_INTERVAL_S after a switch.

    It applies to commands of any origin.
    """

    def __init__(self, limits: Limits) -> None:
        self._names = limits.names
        self._binary = limits.binary
        self._same = _SAME * (limits.upper - limits.lower)
        self._switched = np.full(len(limits.binary), -np.inf)  # time of the last switch [s]

    def apply(self, action: Float64, commanded: Float64, now: float) -> tuple[Float64, tuple[str, ...]]:
        """Return `action` [D], with grippers that would switch too soon held at `commanded` [D], and a note on each of
        them.
        """
        early = now - self._switched < MIN_SWITCH_INTERVAL_S - _EARLY_S
        if not early.any() or action.shape != commanded.shape:
            return action, ()
        dwelling = early & self._switches(action, commanded)
        if not dwelling.any():
            return action, ()
        notes = tuple(
            f"{self._names[i]} kept at {round(float(commanded[i]), 4):g}: it switches once per "
            f"{MIN_SWITCH_INTERVAL_S:g} s at most"
            for i in np.flatnonzero(dwelling)
        )
        return np.where(dwelling, commanded, action), notes

    def record_command(self, before: Float64, now_sent: Float64, now: float) -> None:
        """Record that `now_sent` [D] was sent after `before` [D]; grippers that switched are held from the time `now`
        [s] on.
        """
        self._switched[self._switches(now_sent, before)] = now

    def _switches(self, action: Float64, before: Float64) -> np.ndarray:
        return np.asarray(self._binary & (np.abs(action - before) > self._same))
