"""Steady servo error: displacement of joints at rest because of gravity and payload."""

from __future__ import annotations

from collections import deque
from itertools import takewhile
from typing import NamedTuple

import numpy as np

from runtime.core.types import Float64
from runtime.motion.timeline import difference
from runtime.processes.control.actuator import RobotActuator, TickSettings

_EVERY_S = 0.05  # [s] between samples
_REST_S = 0.25  # [s] for which command and reading of a stationary joint are constant
_STILL = 1e-3  # [rad] motion of a constant command
_QUIET = 0.01  # [rad] motion of a constant reading, with noise
_WINDOW_S = 1.0  # [s] in which a steady error must not grow
_GROWN = 0.01  # [rad] growth beyond noise
_TOLD = 0.01  # [rad] least motion of a command in that time
_FOLLOWED = 0.3  # share of it by which a blocked joint follows at most; a free one twice that at least
_UNSEEN_S = 0.5  # [s] without joints after which the robot may have been moved


class _Sample(NamedTuple):
    time: float
    commanded: Float64
    error: Float64


class SteadyError:
    """Detector of joints with a steady servo error.

    It distinguishes an arm that sags below its command from one that is blocked or moving. If the command of a sagging
    arm followed the measurement, the arm would sink tick by tick. A lasting error is caused by the servo, and is no
    reason to move the command. An error that has grown within the last second, or arose while the command moved and its
    joint did not, may be caused by an obstacle.
    """

    def __init__(self, settings: TickSettings, inherited: bool) -> None:
        """Begin without samples.

        `inherited` is True if the present command was sent by an earlier control process.
        """
        self._settings = settings
        self._samples: deque[_Sample] = deque()
        self._inherited = inherited
        # Error of each joint when it was last stationary [rad]; NaN before.
        self.last: Float64 = np.full(len(settings.limits.names), np.nan)
        self._presses = np.zeros(len(self.last), bool)  # joints that did not follow their command, bool [D]

    def update(self, robot: RobotActuator, measured: Float64 | None, now: float) -> None:
        """Add a sample; call at each tick. `measured` [D] is None if the joints are unknown."""
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
        """Discard samples while the command is being moved to the measured position: they do not show how joints
        follow.
        """
        self._samples.clear()
        self._presses[:] = False

    def unchanged_joints(self, robot: RobotActuator, measured: Float64, now: float) -> np.ndarray:
        """Return the joints whose command a stop does not change, bool [D].

        A joint is among them for one of two reasons. Either its error is steady, or its command has been constant for
        so long that the cause of a displacement is unknown, for example a slipped encoder. `DisplacementMonitor`
        handles such displacements.
        """
        if self._inherited:
            error = self._error(robot, measured)
            standing = self._settings.limits.position_mask & (
                np.abs(error) <= self._settings.safety.steady_error
            )
        else:
            self._note(robot, measured, now)
            standing, error = self._standing(now)
            # Joints not yet known to be stationary, just after engaging, with a constant command.
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
        """Return the joints, bool [D], that are displaced although their command rested.

        Only displacements above a servo error count, and not joints that failed to follow a moving command.
        """
        rested = now - self._samples[0].time >= _WINDOW_S - _EVERY_S if self._samples else False
        far = np.abs(self._error(robot, measured)) > self._settings.safety.sagged
        rests = np.ptp([sample.commanded for sample in self._samples], axis=0) <= _STILL if rested else False
        return self._settings.limits.position_mask & far & rests & ~self._presses

    @property
    def last_error(self) -> Float64:
        """Error of each joint when it was last stationary [D]; 0 if it never was."""
        return np.nan_to_num(self.last)

    def _note(self, robot: RobotActuator, measured: Float64, now: float) -> None:
        if self._samples and now - self._samples[-1].time > _UNSEEN_S:
            self._samples.clear()
        self._samples.append(_Sample(now, robot.commanded.copy(), self._error(robot, measured)))
        while now - self._samples[0].time > _WINDOW_S:
            self._samples.popleft()
        first, newest = self._samples[0], self._samples[-1]
        commanded_travel = newest.commanded - first.commanded
        followed = commanded_travel - (newest.error - first.error)
        moved = np.abs(commanded_travel) > _TOLD
        self._presses |= moved & (followed * np.sign(commanded_travel) < _FOLLOWED * np.abs(commanded_travel))
        self._presses &= ~(
            moved & (followed * np.sign(commanded_travel) > 2.0 * _FOLLOWED * np.abs(commanded_travel))
        )

    def _error(self, robot: RobotActuator, measured: Float64) -> Float64:
        return difference(robot.commanded, measured, self._settings.dims.wrapping)

    def _standing(self, now: float) -> tuple[np.ndarray, Float64]:
        """Return the stationary joints with a steady error, bool [D], and the errors [D]."""
        lately = list(takewhile(lambda sample: now - sample.time <= _REST_S, reversed(self._samples)))
        commands = np.array([sample.commanded for sample in lately])
        errors = np.array([sample.error for sample in lately])
        error = np.median(errors, axis=0)
        least = np.abs([sample.error for sample in self._samples]).min(axis=0)
        rests = (np.ptp(commands, axis=0) <= _STILL) & (np.ptp(commands - errors, axis=0) <= _QUIET)
        steady = (np.abs(error) <= self._settings.safety.steady_error) & (np.abs(error) - least <= _GROWN)
        covered = now - self._samples[0].time >= _REST_S - _EVERY_S
        return np.asarray(
            self._settings.limits.position_mask & rests & steady & covered & ~self._presses
        ), error
