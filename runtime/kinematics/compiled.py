"""Kinematics in compiled loops: forward over the robot's chains, inverse by damped least squares in a hard box."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

from robots import Chain, Group, Robot
from runtime.errors import SetupError
from runtime.kinematics.base import IkResult, Kinematics, KinematicsError, KinematicsSettings
from runtime.kinematics.tables import Way, tables_of
from runtime.types import Float64

if TYPE_CHECKING:
    from runtime.kinematics.kernels.chunks import Arms


class Config(KinematicsSettings):
    """Damped least squares in loops that numba compiles: microseconds per frame and arm."""

    kind: Literal["compiled"] = "compiled"


def build(config: Config, robot: Robot) -> CompiledKinematics:
    """The kinematics of the robot's arms, with everything compiled or loaded that a solve needs."""
    made = CompiledKinematics(robot, config)
    made.warm_up()
    return made


class CompiledKinematics(Kinematics):
    """Forward and inverse kinematics in float64; each arm is solved by itself, frame after frame."""

    def __init__(self, robot: Robot, config: Config | None = None) -> None:
        try:
            from runtime.kinematics.kernels import chains, chunks, frames, sizes
        except ImportError as error:
            raise SetupError(str(error)) from error
        self._config = config or Config()
        self._dim = robot.dim
        own = [(group, chain) for group in robot.arms if (chain := group.chain) is not None]
        self._count = len(own)
        self._whole = tables_of([_whole(group, chain) for group, chain in own])
        self._arms = _arms_of(robot, own, self._config.velocity_scale)
        self._chains, self._chunks = chains, chunks
        self._reach = sizes.size_of(self._whole.drive.shape[1])
        self._sizes = (
            sizes.size_of(self._arms.own.drive.shape[1]),
            sizes.size_of(self._arms.carriers.drive.shape[1]),
            sizes.size_of(self._arms.dims.shape[1]),
        )
        weights = np.array([self._config.position_weight, self._config.rotation_weight])
        self._costs = frames.Costs(weights, self._config.rest_weight, self._config.max_iterations)
        self._tolerances = chunks.Tolerances(
            self._config.position_tolerance, self._config.rotation_tolerance, self._config.singular_below
        )

    def warm_up(self) -> None:
        """Compiles what is not on disk yet and loads the rest, so that nothing of it is left for a command."""
        seed = np.zeros(self._dim)
        self.solve(self.forward(seed)[None], seed)

    def forward(self, q: Float64) -> Float64:
        """Poses [..., arms, 7] for joint vectors [..., D]; KinematicsError for another width."""
        q = np.array(q, dtype=np.float64, order="C")
        if q.shape[-1:] != (self._dim,):
            raise KinematicsError(f"joints of shape {q.shape} were given; allowed: [..., {self._dim}]")
        poses = np.empty((*q.shape[:-1], self._count, 7))
        rows = q.reshape(-1, self._dim)
        self._chains.poses_of(self._reach, self._whole, rows, poses.reshape(len(rows), self._count, 7))
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

        Quaternions may have any length above zero. Raises KinematicsError for wrong shapes, numbers that are not
        finite, a quaternion of length zero, a `dt` that is not above zero or an `anchor_row` below it.
        """
        targets, seed = self._targets(targets), self._vector("a seed", seed)
        if dt is not None and not 0 < dt < np.inf:
            raise KinematicsError(
                f"dt = {dt} s was given; allowed: above zero, or None for no velocity limit"
            )
        if anchor_row < 0:
            raise KinematicsError(f"anchor_row = {anchor_row} was given; allowed: 0 or above")
        held = seed if anchor is None else self._vector("an anchor", anchor)
        asked = self._chunks.Asked(
            targets, seed[None], float(dt or 0.0), held, -1 if anchor is None else int(anchor_row)
        )
        frames = (len(targets), self._count)
        solved = self._chunks.Solved(
            np.empty((len(targets), self._dim)),
            np.empty(frames),
            np.empty(frames),
            np.empty(frames, dtype=np.uint8),
        )
        wrong = self._chunks.solve_chunk(
            *self._sizes, self._arms, self._costs, self._tolerances, asked, solved
        )
        if wrong == self._chunks.NOT_FINITE:
            raise KinematicsError("a target, the seed or the anchor holds a number that is not finite")
        if wrong == self._chunks.NO_QUATERNION:
            raise KinematicsError("a target's quaternion has length zero; allowed: any other")
        return IkResult(*solved)

    def _targets(self, given: Float64) -> Float64:
        targets = np.array(given, dtype=np.float64, order="C")
        if targets.ndim != 3 or targets.shape[1:] != (self._count, 7):
            raise KinematicsError(
                f"targets of shape {targets.shape} were given; allowed: [T, {self._count}, 7]"
            )
        return targets

    def _vector(self, what: str, given: Float64) -> Float64:
        vector = np.array(given, dtype=np.float64, order="C")
        if vector.shape != (self._dim,):
            raise KinematicsError(f"{what} of shape {vector.shape} was given; allowed: [{self._dim}]")
        return vector


def _whole(group: Group, chain: Chain) -> Way:
    """From the arm's frame to its end effector, driven by the robot's vector."""
    if group.carrier is None:
        return Way([chain], [group.joint_dims.tolist()])
    return Way([group.carrier, chain], [group.carrier_dims.tolist(), group.joint_dims.tolist()])


def _arms_of(robot: Robot, own: list[tuple[Group, Chain]], velocity_scale: float) -> Arms:
    from runtime.kinematics.kernels.chunks import Arms

    size = max((chain.size for _, chain in own), default=0)
    arms = Arms(
        own=tables_of([Way([chain], [list(range(chain.size))]) for _, chain in own]),
        carriers=tables_of(
            [
                Way([], []) if group.carrier is None else Way([group.carrier], [group.carrier_dims.tolist()])
                for group, _ in own
            ]
        ),
        sizes=np.array([chain.size for _, chain in own], dtype=np.int64),
        dims=np.zeros((len(own), size), dtype=np.int64),
        lower=np.zeros((len(own), size)),
        upper=np.zeros((len(own), size)),
        speed=np.zeros((len(own), size)),
    )
    for arm, (group, chain) in enumerate(own):
        dims, count = group.joint_dims, chain.size
        arms.dims[arm, :count] = dims
        arms.lower[arm, :count] = robot.lower[dims]
        arms.upper[arm, :count] = robot.upper[dims]
        arms.speed[arm, :count] = robot.velocity[dims] * velocity_scale
    return arms
