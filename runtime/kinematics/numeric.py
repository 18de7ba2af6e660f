"""Kinematics in numpy: forward over the robot's chains, inverse by damped least squares in a hard box."""

from __future__ import annotations

from typing import Literal

import numpy as np

from robots import Chain, Group, Robot
from robots.rotations import rotation_vector, transform_of
from runtime.kinematics.base import IkFlag, IkResult, Kinematics, KinematicsError, KinematicsSettings
from runtime.types import Float64

_POSITION_WEIGHT = 50.0  # per m
_ROTATION_WEIGHT = 10.0  # per rad
_REST_WEIGHT = 0.02  # per rad from the frame before: holds still what the pose leaves open
_WEIGHTS = np.repeat([_POSITION_WEIGHT, _ROTATION_WEIGHT], 3)
_LARGEST_STEP = 0.5  # rad (m) of one iteration: linearisation is worth nothing farther out
_CLOSE_ENOUGH = 1e-9  # weighted squared error: below 1 um and 5 urad
_STALLED = 1e-4  # a relative fall of the cost below which another iteration is not worth its time


class Config(KinematicsSettings):
    """Damped least squares in numpy: no extra package, a few hundred microseconds per frame and arm."""

    kind: Literal["numeric"] = "numeric"


def build(config: Config, robot: Robot) -> NumericKinematics:
    """The kinematics of the robot's arms."""
    return NumericKinematics(robot, config)


class NumericKinematics(Kinematics):
    """Forward and inverse kinematics in float64; each arm is solved by itself, frame after frame."""

    def __init__(self, robot: Robot, config: Config | None = None) -> None:
        self._robot = robot
        self._config = config or Config()
        self._arms = [_Arm(robot, group, chain) for group in robot.arms if (chain := group.chain) is not None]

    def forward(self, q: Float64) -> Float64:
        """Poses [..., arms, 7] for joint vectors [..., D]; KinematicsError for another width."""
        q = np.asarray(q, dtype=np.float64)
        if q.shape[-1:] != (self._robot.dim,):
            raise KinematicsError(f"joints of shape {q.shape} were given; allowed: [..., {self._robot.dim}]")
        poses = np.empty((*q.shape[:-1], len(self._arms), 7))
        for index, arm in enumerate(self._arms):
            poses[..., index, :] = arm.group.pose(q)
        return poses

    def solve(
        self,
        targets: Float64,
        seed: Float64,
        dt: float | None = None,
        anchor: Float64 | None = None,
        anchor_row: int = 0,
    ) -> IkResult:
        """Joints for poses [T, arms, 7]; the errors are measured on the joints that are returned.

        Quaternions are normalised. Raises KinematicsError for wrong shapes, numbers that are not finite, a
        quaternion of length zero or a `dt` that is not above zero.
        """
        targets, seed = self._checked(targets, seed, dt)
        q = np.repeat(seed[None], len(targets), axis=0)
        for index, arm in enumerate(self._arms):
            goals = np.linalg.inv(arm.group.carried(seed)) @ transform_of(targets[:, index])
            start = None if anchor is None else np.asarray(anchor, dtype=np.float64)[arm.dims]
            q[:, arm.dims] = arm.follow(
                goals, seed[arm.dims], dt, start, anchor_row, self._config.max_iterations
            )
        return self._result(q, targets)

    def _result(self, q: Float64, targets: Float64) -> IkResult:
        wanted, found = transform_of(targets), transform_of(self.forward(q))
        position_error = np.linalg.norm(wanted[..., :3, 3] - found[..., :3, 3], axis=-1)
        apart = rotation_vector(wanted[..., :3, :3] @ np.swapaxes(found[..., :3, :3], -1, -2))
        rotation_error = np.linalg.norm(apart, axis=-1)
        near = position_error <= self._config.position_tolerance
        aligned = rotation_error <= self._config.rotation_tolerance
        flags = np.where(near & aligned, 0, int(IkFlag.OVER_TOLERANCE)).astype(np.uint8)
        return IkResult(q, position_error, rotation_error, flags)

    def _checked(self, targets: Float64, seed: Float64, dt: float | None) -> tuple[Float64, Float64]:
        targets, seed = np.array(targets, dtype=np.float64), np.asarray(seed, dtype=np.float64)
        arms, dim = len(self._arms), self._robot.dim
        if targets.ndim != 3 or targets.shape[1:] != (arms, 7):
            raise KinematicsError(f"targets of shape {targets.shape} were given; allowed: [T, {arms}, 7]")
        if seed.shape != (dim,):
            raise KinematicsError(f"a seed of shape {seed.shape} was given; allowed: [{dim}]")
        if dt is not None and not dt > 0:
            raise KinematicsError(
                f"dt = {dt} s was given; allowed: above zero, or None for no velocity limit"
            )
        if not np.isfinite(targets).all() or not np.isfinite(seed).all():
            raise KinematicsError("a target or the seed holds a number that is not finite")
        norms = np.linalg.norm(targets[..., 3:], axis=-1, keepdims=True)
        if (norms < 1e-6).any():
            raise KinematicsError("a target's quaternion has length zero; allowed: any other")
        targets[..., 3:] /= norms
        return targets, seed


class _Arm:
    """One arm's chain, its places in the robot's vector, its limits."""

    def __init__(self, robot: Robot, group: Group, chain: Chain) -> None:
        self.group = group
        self.chain = chain
        self.dims = group.joint_dims
        self._lower = robot.lower[self.dims]
        self._upper = robot.upper[self.dims]
        self._velocity = robot.velocity[self.dims]

    def follow(
        self,
        goals: Float64,
        seed: Float64,
        dt: float | None,
        anchor: Float64 | None,
        anchor_row: int,
        max_iterations: int,
    ) -> Float64:
        """Joints [T, n] for transforms [T, 4, 4], each frame started from the one before."""
        path = np.empty((len(goals), len(self.dims)))
        q = np.clip(seed, self._lower, self._upper)
        before = None
        for index, goal in enumerate(goals):
            before = anchor if index == anchor_row and anchor is not None else before
            lower, upper = self._lower, self._upper
            if dt is not None and before is not None:
                before = np.clip(before, self._lower, self._upper)
                lower = np.maximum(lower, before - self._velocity * dt)
                upper = np.minimum(upper, before + self._velocity * dt)
                q = np.clip(q, lower, upper)
            q = path[index] = _solve(self.chain, goal, q, lower, upper, max_iterations)
            before = None if anchor is not None and index < anchor_row else q
        return path


def _solve(
    chain: Chain, goal: Float64, start: Float64, lower: Float64, upper: Float64, max_iterations: int
) -> Float64:
    """The joints in [lower, upper] whose tip comes closest to `goal`, by Levenberg-Marquardt from `start`.

    Damping by the gain ratio (Nielsen 1999, IMM-REP-1999-05); every step is a small quadratic problem in the
    box. Ends when the error is negligible or its cost has stopped falling, which bounds what an unreachable
    target takes.
    """
    q = start
    jacobian, error = _linearise(chain, goal, q)
    cost = float(error @ error)
    rest = _REST_WEIGHT**2
    damping, growth = 1e-3, 2.0
    for _ in range(max_iterations):
        if cost - rest * float((q - start) @ (q - start)) <= _CLOSE_ENOUGH:
            break
        hessian = jacobian.T @ jacobian
        hessian.flat[:: len(q) + 1] += rest
        gradient = jacobian.T @ error + rest * (q - start)
        room = np.maximum(lower - q, -_LARGEST_STEP), np.minimum(upper - q, _LARGEST_STEP)
        damped = hessian + np.diag(damping * (1.0 + np.diagonal(hessian)))
        step = _step_in_box(damped, gradient, *room)
        predicted = -float(step @ (2 * gradient + hessian @ step))
        if predicted <= 1e-3 * _STALLED * cost:
            break
        trial = np.clip(q + step, lower, upper)
        trial_jacobian, trial_error = _linearise(chain, goal, trial)
        trial_cost = float(trial_error @ trial_error) + rest * float((trial - start) @ (trial - start))
        fall = cost - trial_cost
        if fall <= 0:
            damping *= growth
            growth *= 2.0
            continue
        q, jacobian, error, cost = trial, trial_jacobian, trial_error, trial_cost
        damping *= max(1 / 3, 1 - (2 * fall / predicted - 1) ** 3)
        growth = 2.0
        if fall <= _STALLED * (cost + fall):
            break
    return q


def _linearise(chain: Chain, goal: Float64, q: Float64) -> tuple[Float64, Float64]:
    """Weighted Jacobian [6, n] and error [6] of the tip against the goal.

    The rotation's error is the rotation vector from goal to tip; its derivative is taken as the geometric
    one, which leaves the gradient exact.
    """
    tip, jacobian = chain.jacobian(q)
    error = np.empty(6)
    error[:3] = tip[:3, 3] - goal[:3, 3]
    error[3:] = rotation_vector(tip[:3, :3] @ goal[:3, :3].T)
    return jacobian * _WEIGHTS[:, None], error * _WEIGHTS


def _step_in_box(system: Float64, gradient: Float64, lower: Float64, upper: Float64) -> Float64:
    """The d in [lower, upper] (which holds 0) that minimises gradient . d + d . system . d / 2.

    Primal active set for a strictly convex problem (Nocedal and Wright, Numerical Optimization, 16.5): walk
    to the first wall, hold that joint, solve again for the others; let go of a wall that the slope leaves.
    Each part lowers the value, so a step that is cut short still descends.
    """
    step = np.zeros_like(gradient)
    slope = gradient
    free = ~((lower >= 0) & (gradient > 0) | (upper <= 0) & (gradient < 0))
    for _ in range(4 * len(gradient)):
        moving = np.flatnonzero(free)
        if len(moving):
            move = np.linalg.solve(system[np.ix_(moving, moving)], -slope[moving])
            wall = np.where(move > 0, upper[moving], lower[moving])
            beyond = np.flatnonzero(np.abs(move) > np.abs(wall - step[moving]))
            if len(beyond):
                shares = (wall - step[moving])[beyond] / move[beyond]
                first = np.argmin(shares)
                step[moving] += shares[first] * move
                stopped = moving[beyond[first]]
                step[stopped] = wall[beyond[first]]
                free[stopped] = False
                slope = gradient + system @ step
                continue
            step[moving] += move
            if free.all():
                break
            slope = gradient + system @ step
        leaving = ~free & np.where(step >= upper, slope > 0, slope < 0) & (lower < upper)
        if not leaving.any():
            break
        free[np.argmax(np.where(leaving, np.abs(slope), 0.0))] = True
    return step
