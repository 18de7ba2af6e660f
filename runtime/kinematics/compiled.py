"""Compiled kinematics: forward over the robot's chains, inverse by damped least squares in a hard box."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from functools import partial
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from robots import Chain, Group, Robot
from runtime.core.errors import SetupError
from runtime.core.types import Float64
from runtime.kinematics import kernel_cache
from runtime.kinematics.base import IkResult, Kinematics, KinematicsError, KinematicsSettings
from runtime.kinematics.chain_records import (
    POSED,
    ChainSequence,
    Record,
    Records,
    chain_records,
)
from runtime.kinematics.replanning import (
    MIN_LIMIT_MARGIN,
    ROOMIER,
    arms_missing_targets,
    replan,
    sample_postures,
)

_WRONG = {  # by return value of kernels.chunks.solve_chunk
    1: "a target, the seed or the anchor holds a number that is not finite",
    2: "a target's quaternion has length zero; allowed: any other",
}
_ROOM = 0.8  # [rad, m] distance of redundant joints from their limits, if home has it
_TRIED = 24  # postures, besides home, from which the last pose of a missed chunk is solved
_log = logging.getLogger(__name__)


class Config(KinematicsSettings):
    """Damped least squares in loops compiled by numba: microseconds per frame and arm."""

    kind: Literal["compiled"] = "compiled"
    home_rate: Annotated[float, Field(ge=0)] = 4.0
    """Share of the way home per second by which redundant degrees of freedom (arms with more than six joints) move, no
    joint faster than a fifth of its velocity limit; joint limits repel at the same rate. 0: they stay as they are."""


def build(config: Config, robot: Robot) -> CompiledKinematics:
    """Return the kinematics of the robot's arms, with everything compiled or loaded that `solve` needs."""
    kinematics = CompiledKinematics(robot, config)
    kinematics.warm_up()
    return kinematics


def is_compiled(robot: Robot) -> bool:
    """Return True if all kernels for the robot are compiled."""
    return kernel_cache.is_compiled(robot)


class CompiledKinematics(Kinematics):
    """Forward and inverse kinematics in float64; arms are solved separately, frame by frame."""

    def __init__(self, robot: Robot, config: Config | None = None) -> None:
        try:
            from runtime.kinematics.kernels import chunk_solver, forward_kinematics, frame_solver
        except ImportError as error:
            raise SetupError(str(error)) from error
        config = config or Config()
        self._dim = robot.dim
        own = [(group, chain) for group in robot.arms if (chain := group.chain) is not None]
        self._whole = chain_records([_full_chain(group, chain) for group, chain in own])
        self._arms = _arms_of(robot, own, config.velocity_scale)
        self._postures = [
            sample_postures(robot.poses["home"][dims], robot.lower[dims], robot.upper[dims], _TRIED)
            for dims in (group.joint_dims for group, _ in own)
        ]
        self._robot = robot
        self._poses_of, self._solve_chunk = forward_kinematics.compute_poses, chunk_solver.solve_chunk
        self._reach_type = forward_kinematics.fk_buffer_type(self._whole["drive"].shape[1])
        self._scratch_type = chunk_solver.scratch_type(*_lengths(self._arms))
        self._costs = frame_solver.Costs(
            config.position_weight,
            config.rotation_weight,
            config.rest_weight,
            config.home_rate,
            config.max_iterations,
        )
        self._tolerances = chunk_solver.Tolerances(
            config.position_tolerance, config.rotation_tolerance, config.singular_below
        )

    def warm_up(self) -> None:
        """Load all kernels, and compile those that are not cached, so that no command waits for it."""
        if not kernel_cache.is_compiled(self._robot):
            _log.info("compiling the kinematics for this processor, once; this takes some seconds")
        kernel_cache.load(self._solve_once)
        kernel_cache.note_compiled(self._robot)

    def _solve_once(self) -> None:
        seed = np.zeros(self._dim)
        self.solve(self.forward(seed)[None], seed)

    def forward(self, q: Float64) -> Float64:
        """Return poses [..., arms, 7] for joint vectors [..., D].

        Raises:
            KinematicsError: The joint vectors have another width.
        """
        q = np.array(q, dtype=np.float64, order="C")
        if q.shape[-1:] != (self._dim,):
            raise KinematicsError(f"joints of shape {q.shape} were given; allowed: [..., {self._dim}]")
        poses = np.empty((*q.shape[:-1], len(self._arms), 7))
        rows = q.reshape(-1, self._dim)
        reach = np.empty(1, dtype=self._reach_type)
        self._poses_of(self._whole, rows, reach, poses.reshape(len(rows), len(self._arms), 7))
        return poses

    def solve(
        self,
        targets: Float64,
        seed: Float64,
        dt: float | None = None,
        anchor: Float64 | None = None,
        anchor_row: int = 0,
    ) -> IkResult:
        """Solve for poses [T, arms, 7] as `Kinematics.solve` describes; errors are measured on the returned joints.

        Quaternions may have any length above zero.

        Raises:
            KinematicsError: Wrong shapes, numbers that are not finite, a quaternion of length zero, a `dt` of zero or
                less, or a negative `anchor_row`.
        """
        targets, seed = self._targets(targets), self._vector("a seed", seed)
        if dt is not None and not 0 < dt < np.inf:
            raise KinematicsError(
                f"dt = {dt} s was given; allowed: above zero, or None for no velocity limit"
            )
        if anchor_row < 0:
            raise KinematicsError(f"anchor_row = {anchor_row} was given; allowed: 0 or above")
        reference = seed if anchor is None else self._vector("an anchor", anchor)
        row = -1 if anchor is None else int(anchor_row)
        result = self._solve_rows(self._arms, targets, seed, dt, reference, row)
        if dt is not None:
            self._replan_missed(result, targets, seed, dt, reference, row)
        return result

    def _replan_missed(
        self, result: IkResult, targets: Float64, seed: Float64, dt: float, reference: Float64, row: int
    ) -> None:
        """Replan in `result` the arms that reach the first pose but miss a later one, or that end near limits.

        The first pose is the pose of the anchor's row, `row`. If there is no anchor, `row` is -1, and the first pose is
        that of row 1. `reference` are the joints [D] before the anchor's row. Ending near a limit matters because the
        next chunk is unknown, and may continue towards the limit.
        """
        begin = row if row >= 0 else 1
        if begin >= len(targets):
            return
        late = arms_missing_targets(result, begin)
        for index, arm in enumerate(self._arms):
            room = partial(_limit_margin, arm)
            spare = room(result.q[-1])
            cramped = spare < MIN_LIMIT_MARGIN and result.reached[begin:, index].all()
            if index not in late and not cramped:
                continue
            least = spare + ROOMIER if cramped else -np.inf
            dims = arm["dims"][: arm["joints"]]
            start = seed.copy()
            start[dims] = (reference if row >= 0 else result.q[0])[dims]
            poses = np.ascontiguousarray(targets[begin:, index : index + 1])
            sweep = partial(self._solve_rows, self._arms[index : index + 1])
            plan = replan(sweep, poses, start, dt, dims, self._postures[index], room, least)
            if plan is None and index in late and arm["joints"] > POSED:
                # The pull towards home may lead away from later poses: solve once more without it.
                plan = sweep(poses, start, dt, start, 0, home_rate=0.0)
                plan = plan if plan.reached.all() else None
            if plan is not None:
                result.q[begin:, dims] = plan.q[:, dims]
                result.position_error[begin:, index] = plan.position_error[:, 0]
                result.rotation_error[begin:, index] = plan.rotation_error[:, 0]
                result.flags[begin:, index] = plan.flags[:, 0]

    def _solve_rows(
        self,
        arms: Records,
        targets: Float64,
        seed: Float64,
        dt: float | None,
        anchor: Float64,
        anchor_row: int,
        guide: Float64 | None = None,
        home_rate: float | None = None,
    ) -> IkResult:
        """Solve the poses `targets` [T, A, 7] of some of the arms by one call of the kernel.

        Arrays must be contiguous.

        Args:
            arms: Records of these arms [A].
            targets: Poses, as in `solve`.
            seed: Joints [D], as in `solve`.
            dt: Time between frames [s]; None: no velocity limits.
            anchor: Joints [D] before the anchor's row.
            anchor_row: The anchor's row; -1 if there is no anchor.
            guide: Joints [T, D] that the solution should approach; None for no guide.
            home_rate: Rate at which redundant joints return to home [1/s]; None: that of the configuration.
        """
        costs = self._costs if home_rate is None else self._costs._replace(home_rate=home_rate)
        frames = (len(targets), len(arms))
        q, away, astray = np.empty((len(targets), self._dim)), np.empty(frames), np.empty(frames)
        flags = np.empty(frames, dtype=np.uint8)
        wrong = self._solve_chunk(
            arms,
            costs,
            self._tolerances,
            targets,
            seed[None],
            float(dt or 0.0),
            anchor,
            anchor_row,
            np.empty((0, self._dim)) if guide is None else guide,
            np.empty(1, dtype=self._scratch_type),
            q,
            away,
            astray,
            flags,
        )
        if wrong:
            raise KinematicsError(_WRONG[wrong])
        return IkResult(q, away, astray, flags)

    def _targets(self, poses: Float64) -> Float64:
        targets = np.array(poses, dtype=np.float64, order="C")
        if targets.ndim != 3 or targets.shape[1:] != (len(self._arms), 7):
            raise KinematicsError(
                f"targets of shape {targets.shape} were given; allowed: [T, {len(self._arms)}, 7]"
            )
        return targets

    def _vector(self, label: str, values: Float64) -> Float64:
        vector = np.array(values, dtype=np.float64, order="C")
        if vector.shape != (self._dim,):
            raise KinematicsError(f"{label} of shape {vector.shape} was given; allowed: [{self._dim}]")
        return vector


def _full_chain(group: Group, chain: Chain) -> ChainSequence:
    """Return the chain from the arm's frame to its end effector, driven by the robot's vector."""
    if group.carrier is None:
        return ChainSequence([chain], [group.joint_dims.tolist()])
    return ChainSequence([group.carrier, chain], [group.carrier_dims.tolist(), group.joint_dims.tolist()])


def _arms_of(robot: Robot, own: Sequence[tuple[Group, Chain]], velocity_scale: float) -> Records:
    """Return the arms as records; the chains of shorter arms are padded with fixed joints."""
    from runtime.kinematics.kernels.chunk_solver import arm_type

    chains = chain_records([ChainSequence([chain], [range(chain.size)]) for _, chain in own])
    carriers = chain_records([_carrier_chain(group) for group, _ in own])
    size = max((chain.size for _, chain in own), default=1)
    arms = np.zeros(len(own), dtype=arm_type(chains["drive"].shape[1], carriers["drive"].shape[1], size))
    arms["own"], arms["carrier"] = chains, carriers
    for arm, (group, chain) in zip(arms, own, strict=True):
        dims, count = group.joint_dims, chain.size
        arm["joints"] = count
        arm["dims"][:count] = dims
        arm["lower"][:count] = robot.lower[dims]
        arm["upper"][:count] = robot.upper[dims]
        arm["speed"][:count] = robot.velocity[dims] * velocity_scale
        arm["home"][:count] = home = robot.poses["home"][dims]
        arm["below"][:count] = np.minimum(_ROOM, home - robot.lower[dims])
        arm["above"][:count] = np.minimum(_ROOM, robot.upper[dims] - home)
    return arms


def _limit_margin(arm: Record, q: Float64) -> float:
    """Return the distance of joints [D] to the nearest limit, relative to _ROOM; inf for an arm without redundancy.

    Limits to which home itself is nearer than _ROOM do not count, because no posture is better there.
    """
    count = arm["joints"]
    if count <= POSED:
        return np.inf
    at = q[arm["dims"][:count]]
    rooms = np.concatenate([at - arm["lower"][:count], arm["upper"][:count] - at])
    margins = np.concatenate([arm["below"][:count], arm["above"][:count]])
    return float(rooms[margins >= _ROOM].min(initial=np.inf) / _ROOM)


def _carrier_chain(group: Group) -> ChainSequence:
    if group.carrier is None:
        return ChainSequence([], [])
    return ChainSequence([group.carrier], [group.carrier_dims.tolist()])


def _lengths(arms: Records) -> tuple[int, int, int]:
    """Return the three lengths of the arms' records.

    A record has room for this many joints of the arm's own chain, joints of the arm's carrier, and values in the
    robot's vector that drive these joints.
    """
    return (
        arms["own"]["drive"].shape[1],
        arms["carrier"]["drive"].shape[1],
        arms["dims"].shape[1],
    )
