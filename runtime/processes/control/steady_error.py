"""Steady servo error: how far joints stand from their command while both rest, because of gravity and payload."""

from __future__ import annotations

from collections import deque
from itertools import takewhile
from typing import NamedTuple

import numpy as np

from runtime.core.types import Float64
from runtime.motion.timeline import difference
from runtime.processes.control.actuator import RobotActuator, TickSettings

_EVERY_S = 0.05  # between samples
_REST_S = 0.25  # for which command and reading rest in a joint that stands
_STILL = 1e-3  # [rad] of a command that rests
_QUIET = 0.01  # [rad] of a reading that rests, noise included
_WINDOW_S = 1.0  # in which the error of a joint that stands has not grown
_GROWN = 0.01  # [rad] more than noise
_TOLD = 0.01  # [rad] of a command that has moved within that time
_FOLLOWED = 0.3  # of that way, by a joint that something holds up; a free one goes twice as far at least
_UNSEEN_S = 0.5  # without joints: whatever happened to the robot was not seen


class _Sample(NamedTuple):
    time: float
    commanded: Float64
    error: Float64


class SteadyError:
    """Tells an arm that stands below its command from one that is held up by something, or moves.

    A command that follows the measurement of an arm that gravity pulls down makes it sink, tick by tick. An error that
    has lasted is that of the servo, and says nothing about where the arm ought to be. One that has grown within the
    last second, or came of a command that went on while its joint did not, may be something in the way.
    """

    def __init__(self, settings: TickSettings, inherited: bool) -> None:
        """`inherited`: the command is that of a control that ran before this one."""
        self._settings = settings
        self._samples: deque[_Sample] = deque()
        self._inherited = inherited
        # Of each joint, when it last stood [rad]; NaN before it was seen to stand.
        self.last: Float64 = np.full(len(settings.limits.names), np.nan)
        self._presses = np.zeros(len(self.last), bool)  # joints that did not follow their command, bool [D]

    def look(self, robot: RobotActuator, measured: Float64 | None, now: float) -> None:
        """Take note of a tick; `measured` [D], None where the joints are not known."""
        if not robot.engaged:
            self._samples.clear()
            self.last[:], self._presses[:] = np.nan, False
            self._inherited = False
        elif measured is not None and not (self._samples and now - self._samples[-1].time < _EVERY_S):
            self._note(robot, measured, now)
            standing, error = self._standing(now)
            self._inherited = self._inherited and now - self._samples[0].time < _REST_S
            self.last = np.where(standing, error, self.last)

    def leave_out(self) -> None:
        """The command is led to the reading now: that says nothing of how joints follow it."""
        self._samples.clear()
        self._presses[:] = False

    def keeps(self, robot: RobotActuator, measured: Float64, now: float) -> np.ndarray:
        """The joints of which a stop leaves the command as it is, bool [D]: they stand within a steady error of it, or
        it has rested for so long that nobody knows what moved their readings away. They may be those of an encoder
        that has slipped: such a command is led (`DisplacementMonitor`).
        """
        if self._inherited:
            error = self._error(robot, measured)
            standing = self._settings.limits.position_mask & (
                np.abs(error) <= self._settings.safety.steady_error
            )
        else:
            self._note(robot, measured, now)
            standing, error = self._standing(now)
            # One that was not seen to stand yet, just after it was taken over, and whose command rests.
            lately = [sample.commanded for sample in self._samples if now - sample.time <= _REST_S]
            new = np.isnan(self.last) & (np.ptp(lately, axis=0) <= _STILL) & ~self._presses
            now_off = self._error(robot, measured)
            new &= self._settings.limits.position_mask & (
                np.abs(now_off) <= self._settings.safety.steady_error
            )
            error, standing = np.where(standing, error, now_off), standing | new
        self.last = np.where(standing, error, self.last)
        return np.asarray(standing | self._moved_at_rest(robot, measured, now))

    def _moved_at_rest(self, robot: RobotActuator, measured: Float64, now: float) -> np.ndarray:
        """Joints, bool [D], that are farther from a command than by an error, and did not come there by its moves."""
        rested = now - self._samples[0].time >= _WINDOW_S - _EVERY_S if self._samples else False
        far = np.abs(self._error(robot, measured)) > self._settings.safety.sagged
        rests = np.ptp([sample.commanded for sample in self._samples], axis=0) <= _STILL if rested else False
        return self._settings.limits.position_mask & far & rests & ~self._presses

    @property
    def known(self) -> Float64:
        """The error of each joint when it last stood [D]; 0 for one that was not seen to stand."""
        return np.nan_to_num(self.last)

    def _note(self, robot: RobotActuator, measured: Float64, now: float) -> None:
        if self._samples and now - self._samples[-1].time > _UNSEEN_S:
            self._samples.clear()
        self._samples.append(_Sample(now, robot.commanded.copy(), self._error(robot, measured)))
        while now - self._samples[0].time > _WINDOW_S:
            self._samples.popleft()
        first, newest = self._samples[0], self._samples[-1]
        told = newest.commanded - first.commanded
        followed = told - (newest.error - first.error)
        moved = np.abs(told) > _TOLD
        self._presses |= moved & (followed * np.sign(told) < _FOLLOWED * np.abs(told))
        self._presses &= ~(moved & (followed * np.sign(told) > 2.0 * _FOLLOWED * np.abs(told)))

    def _error(self, robot: RobotActuator, measured: Float64) -> Float64:
        return difference(robot.commanded, measured, self._settings.dims.wrapping)

    def _standing(self, now: float) -> tuple[np.ndarray, Float64]:
        """The joints, bool [D], that stand within a steady error, and that error [D]."""
        lately = list(takewhile(lambda sample: now - sample.time <= _REST_S, reversed(self._samples)))
        commands = np.array([sample.commanded for sample in lately])
        errors = np.array([sample.error for sample in lately])
        error = np.median(errors, axis=0)
        least = np.abs([sample.error for sample in self._samples]).min(axis=0)
        rests = (np.ptp(commands, axis=0) <= _STILL) & (np.ptp(commands - errors, axis=0) <= _QUIET)
        steady = (np.abs(error) <= self._settings.safety.steady_error) & (np.abs(error) - least <= _GROWN)
        seen = now - self._samples[0].time >= _REST_S - _EVERY_S
        return np.asarray(self._settings.limits.position_mask & rests & steady & seen & ~self._presses), error
