"""Smooth, visible motion of a whole robot, for stand-in policies and the simulated node's leader."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from runtime.core.types import Float32, Float64

if TYPE_CHECKING:
    from robots import Robot

_AMPLITUDE = 0.25  # [rad] of each joint
_TURN = 1.2  # [rad/s] of phase: one gesture takes 5.2 s
_SPEED = 0.8  # [rad/s] highest speed of a joint
_LEAD = 0.13  # [s] by which targets are ahead of the measured joints, as in teleoperated data
_GRIPPER_TIME = 2.0  # [s] least time for the full range of a gripper


class Gesture:
    """Closed path around home, parametrised by a phase that can be computed from the joints, so that it needs no state.

    The first two joints of the first arm move in a circle, which gives the phase; every other arm joint follows with a
    lag of its own; grippers open and close once per round; joints outside arms do not move.
    """

    def __init__(self, robot: Robot, seed: int = 0) -> None:
        self._robot = robot
        moving = np.concatenate([arm.joint_dims for arm in robot.arms])
        room = np.zeros(robot.dim)
        room[moving] = np.minimum(_AMPLITUDE, 0.45 * (robot.upper - robot.lower)[moving])
        home = robot.poses["home"]
        self._centre = np.clip(home, robot.lower + 1.1 * room, robot.upper - 1.1 * room)
        self._room = room
        self._still = np.setdiff1d(np.arange(robot.dim), [*moving, *robot.gripper_dims])
        self._lags = np.random.default_rng(seed).uniform(-0.6, 0.6, robot.dim)
        self._clockwork = moving[:2]
        self._lags[self._clockwork] = [0.0, -0.5 * np.pi]
        self._speed = np.minimum(robot.velocity, _SPEED)
        for dim in robot.gripper_dims:
            self._speed[dim] = (robot.upper - robot.lower)[dim] / _GRIPPER_TIME
        self._speed[list(robot.binary_dims)] = np.inf

    def joints_at(self, phase: float, q: Float64) -> Float64:
        """Return the joints [D] on the path at a phase; joints that the gesture does not move have their value
        in `q`.
        """
        target = self._centre + self._room * np.sin(phase + self._lags)
        for arm in self._robot.arms:
            if arm.gripper is not None and arm.gripper_dim is not None:
                opened = 0.5 + 0.45 * np.sin(phase + self._lags[arm.gripper_dim])
                target[arm.gripper_dim] = arm.gripper.close + opened * (arm.gripper.open - arm.gripper.close)
        target[self._still] = q[self._still]
        return np.asarray(np.clip(target, self._robot.lower, self._robot.upper))

    def phase_of(self, q: Float64) -> float:
        """Return the phase of joints [D].

        It depends only on the direction of the first two joints from the centre of their circle, so that it is defined
        for joints off the path, too.
        """
        sine, minus_cosine = ((q - self._centre) / np.maximum(self._room, 1e-9))[self._clockwork]
        return float(np.arctan2(sine, -minus_cosine))

    def towards(self, phase: float, q: Float64, seconds: float) -> Float64:
        """Return the joints [D] after moving from `q` at limited speed for `seconds` towards the path's point at
        `phase`.
        """
        reach = self._speed * seconds
        return np.asarray(q + np.clip(self.joints_at(phase, q) - q, -reach, reach))

    def chunk(self, q: Float64, horizon: int, rate: float) -> Float32:
        """Return rows float32 [horizon, D] at `rate` [Hz] that continue from joints `q`; they depend only on the
        arguments.
        """
        phase = self.phase_of(q) + _TURN * _LEAD
        rows = np.empty((horizon, self._robot.dim))
        now = np.clip(q, self._robot.lower, self._robot.upper)
        for row in range(horizon):
            now = self.towards(phase + _TURN * (row + 1) / rate, now, 1.0 / rate)
            rows[row] = now
        return rows.astype(np.float32)

    def turn(self, seconds: float) -> float:
        """Return the advance of the phase in `seconds` [rad]."""
        return _TURN * seconds
