"""Kinematics by PyRoki (Kim et al. 2025, arXiv:2505.03728), for users of PyRoki.

It solves the same problem as the default backend, but in JAX. PyRoki is on no package index: install it and jaxls from
their repositories. They are imported only if a deployment selects this kind.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
from types import ModuleType, new_class
from typing import Any, Literal, NamedTuple

import numpy as np

from robots import Group, Robot
from robots.rotations import quaternion_of_matrix, transform_of
from runtime.core.errors import SetupError
from runtime.core.types import Float64
from runtime.kinematics import compiled
from runtime.kinematics.base import IkResult, Kinematics, KinematicsSettings
from runtime.kinematics.evaluation import evaluate_solution

_BUCKET = 64  # [rows] chunks are padded to a multiple, so that few lengths are compiled
_BOX_WEIGHT = 100.0  # per rad beyond the box; the remaining excess is clipped


class Config(KinematicsSettings):
    """PyRoki's least squares in JAX, for users who have it installed and for comparison.

    Redundant degrees of freedom stay as they are: nothing moves them towards home, and a missed chunk is not planned
    again.
    """

    kind: Literal["pyroki"] = "pyroki"


def build(config: Config, robot: Robot) -> PyrokiKinematics:
    """Return the kinematics of the robot's arms, compiled for chunks of up to 64 rows, which takes some ten seconds."""
    kinematics = PyrokiKinematics(robot, config)
    home = robot.poses["home"]
    kinematics.solve(kinematics.forward(home)[None], home)
    return kinematics


def is_compiled(robot: Robot) -> bool:
    """Return False: JAX caches compiled functions in memory only."""
    return False


class PyrokiKinematics(Kinematics):
    """Inverse kinematics in float32 by Levenberg-Marquardt, frame by frame in one compiled scan per arm.

    Joint limits and velocities are a cost term, and the result is clipped, because PyRoki has no hard bounds. Forward
    kinematics and the errors of a result are those of the default backend, in float64.
    """

    def __init__(self, robot: Robot, config: Config | None = None) -> None:
        self._config = config or Config()
        self._robot = robot
        self._default = compiled.build(
            compiled.Config.model_validate(self._config.model_dump(exclude={"kind"})), robot
        )
        libraries = _libraries()
        self._arms = [_Arm(libraries, robot, arm, self._config) for arm in robot.arms]

    def forward(self, q: Float64) -> Float64:
        """Return poses [..., arms, 7] for joint vectors [..., D].

        Raises:
            KinematicsError: The joint vectors have another width.
        """
        return self._default.forward(q)

    def solve(
        self,
        targets: Float64,
        seed: Float64,
        dt: float | None = None,
        anchor: Float64 | None = None,
        anchor_row: int = 0,
    ) -> IkResult:
        """Solve for poses [T, arms, 7] as `Kinematics.solve` describes; errors are measured on the returned joints.

        Raises:
            KinematicsError: In the same cases as the default backend.
        """
        # The default backend checks all arguments, with one row; its solution is not used.
        self._default.solve(targets[:1], seed, dt, anchor, anchor_row)
        targets, seed = np.asarray(targets, np.float64), np.asarray(seed, np.float64)
        q = np.repeat(seed[None], len(targets), axis=0)
        low = np.repeat(self._robot.lower[None], len(targets), axis=0)
        high = np.repeat(self._robot.upper[None], len(targets), axis=0)
        for index, arm in enumerate(self._arms):
            task = _ArmTask(targets[:, index], seed, dt, anchor, anchor_row)
            q[:, arm.dims], low[:, arm.dims], high[:, arm.dims] = arm.follow(task)
        return evaluate_solution(self._robot, self._config, q, targets, (low, high))


class _ArmTask(NamedTuple):
    """Part of a chunk for one arm: its poses [T, 7] in the arm's frame, with the other arguments of `solve`."""

    targets: Float64
    seed: Float64
    dt: float | None
    anchor: Float64 | None
    anchor_row: int


class _Arm:
    """One arm for PyRoki: the serial chain of its own joints, and the compiled loop that solves a chunk."""

    def __init__(self, libraries: _Libraries, robot: Robot, group: Group, config: Config) -> None:
        assert group.chain is not None  # it is an arm
        self._group = group
        self.dims = group.joint_dims[[joint.drive for joint in group.chain.moving]]
        self._lower, self._upper = robot.lower[self.dims], robot.upper[self.dims]
        self._speed = robot.velocity[self.dims] * config.velocity_scale
        self._described = _robot_of(libraries, robot, group)
        self._scan = _scan_of(libraries, config)

    def follow(self, asked: _ArmTask) -> tuple[Float64, Float64, Float64]:
        """Return joints [T, n], and the lower and upper bounds of each row."""
        rows = len(asked.targets)
        goals = np.linalg.inv(self._group.carried(asked.seed)) @ transform_of(_unit(asked.targets))
        poses = np.concatenate([quaternion_of_matrix(goals[:, :3, :3]), goals[:, :3, 3]], axis=-1)
        filled = np.concatenate([poses, np.repeat(poses[-1:], -rows % _BUCKET, axis=0)])
        reference, steps = self._bounds(asked, len(filled))
        seed = np.clip(asked.seed[self.dims], self._lower, self._upper)
        reference = np.clip(reference, self._lower, self._upper)
        inputs = (
            filled,
            steps,
            np.arange(len(filled)) == asked.anchor_row,
            seed,
            reference,
            self._lower,
            self._upper,
        )
        q, low, high = (
            np.asarray(part, np.float64)[:rows]
            for part in self._scan(self._described, *map(_float32, inputs))
        )
        # float32 may round beyond the box by its last digit
        low, high = np.maximum(low, self._lower), np.minimum(high, self._upper)
        return self._cut(q, asked, steps[:rows], reference), low, high

    def _bounds(self, task: _ArmTask, rows: int) -> tuple[Float64, Float64]:
        """Return the joints [n] before the anchor's row, and the largest step of each row from its predecessor [rows,
        n].
        """
        steps = np.full((rows, len(self.dims)), np.inf)
        reference = (task.seed if task.anchor is None else np.asarray(task.anchor, np.float64))[self.dims]
        if task.dt is not None:
            first = 1 if task.anchor is None else task.anchor_row
            steps[first:] = self._speed * task.dt
        return reference, steps

    def _cut(self, q: Float64, task: _ArmTask, steps: Float64, reference: Float64) -> Float64:
        """Return the rows [T, n], clipped in float64 to the joint limits and to the largest steps between rows.

        `steps` has the largest step of each row from the row before it. The anchor's row is the exception: it is
        clipped to the step that it may have from `reference`, not from the row before it.
        """
        cut = np.clip(q, self._lower, self._upper)
        for row in range(len(cut)):
            anchored = task.anchor is not None and row == task.anchor_row
            if row == 0 and not anchored:
                continue
            before = reference if anchored else cut[row - 1]
            cut[row] = np.clip(cut[row], before - steps[row], before + steps[row])
        return cut


class _Libraries(NamedTuple):
    """Imported libraries of PyRoki."""

    jax: ModuleType
    jaxlie: ModuleType
    jaxls: ModuleType
    pyroki: ModuleType
    yourdfpy: ModuleType


def _libraries() -> _Libraries:
    try:
        libraries = _Libraries(*(importlib.import_module(name) for name in _Libraries._fields))
    except ImportError as error:
        raise SetupError(
            f'kinematics.kind = "pyroki": {error}; install PyRoki (chungmin99/pyroki) and jaxls (brentyi/jaxls) from '
            'their repositories, the jaxls of the package index is another project; or use kind = "compiled"'
        ) from error
    importlib.import_module("loguru").logger.disable("jaxls")  # it logs every problem that it builds
    return libraries


def _robot_of(libraries: _Libraries, robot: Robot, group: Group) -> Any:
    """Return PyRoki's robot for the group's chain: its moving joints and the fixed parts between them.

    Arms with equally many joints differ only in numbers, so that one compiled function serves them all.

    Raises:
        SetupError: The chain has a mimic joint.
    """
    assert group.chain is not None  # it is an arm
    describe = libraries.yourdfpy.urdf
    moving = group.chain.moving
    if any((joint.factor, joint.offset) != (1.0, 0.0) for joint in moving) or len(moving) != group.chain.size:
        raise SetupError(
            f'kinematics.kind = "pyroki": a mimic lies on the chain of {group.name}; allowed: arms without, or '
            'kind = "compiled"'
        )
    links = [f"link{index}" for index in range(len(moving) + 2)]
    joints = [
        describe.Joint(
            name=f"joint{index}",
            type="prismatic" if joint.slides else "revolute",
            parent=links[index],
            child=links[index + 1],
            origin=joint.origin,
            axis=joint.axis,
            limit=describe.Limit(
                effort=1.0,
                velocity=float(robot.velocity[dim]),
                lower=float(robot.lower[dim]),
                upper=float(robot.upper[dim]),
            ),
        )
        for index, joint in enumerate(moving)
        for dim in (group.joint_dims[joint.drive],)
    ]
    joints.append(
        describe.Joint(name="tail", type="fixed", parent=links[-2], child=links[-1], origin=group.chain.tail)
    )
    described = describe.Robot(name="arm", links=[describe.Link(name=link) for link in links], joints=joints)
    parsed = libraries.pyroki.Robot.from_urdf(describe.URDF(robot=described, load_meshes=False))
    return dataclasses.replace(parsed, joint_var_cls=_variable_of(libraries, len(moving)))


@functools.cache  # cache: what is compiled is bound to it
def _variable_of(libraries: _Libraries, size: int) -> Any:
    """Return the cached variable type for `size` joints.

    PyRoki makes one per robot, but compiled functions depend on it and shall be shared.
    """
    zeros = libraries.jax.numpy.zeros(size)
    return new_class(
        "Joints", (libraries.jaxls.Var[libraries.jax.Array],), {"default_factory": lambda: zeros}
    )


@functools.cache  # cache: to compile it takes longer than a thousand chunks
def _scan_of(libraries: _Libraries, config: Config) -> Any:
    """Return a function that computes joints and their bounds from an arm and from the poses and bounds of a chunk.

    The function is compiled when it is called with the first arm that has a given number of joints. The compilation
    takes longer than a thousand chunks.
    """
    jax, jaxlie, jaxls = libraries.jax, libraries.jaxlie, libraries.jaxls
    jnp = jax.numpy
    termination = jaxls.TerminationConfig(max_iterations=config.max_iterations)

    def beyond(values: Any, of: Any, low: Any, high: Any) -> Any:
        q = values[of]
        return (jnp.maximum(0.0, q - high) + jnp.maximum(0.0, low - q)) * _BOX_WEIGHT

    box_cost = jaxls.Cost.factory(beyond)

    def frame(robot: Any, carry: Any, row: Any) -> Any:
        variable = robot.joint_var_cls(0)
        before, start, reference, lower, upper = carry
        pose, step, anchored = row
        base = jnp.where(anchored > 0, reference, before)
        low, high = jnp.maximum(lower, base - step), jnp.minimum(upper, base + step)
        start = jnp.clip(start, low, high)
        costs = [
            libraries.pyroki.costs.pose_cost_analytic_jac(
                robot,
                variable,
                jaxlie.SE3(pose),
                jnp.array(len(robot.links.names) - 1),
                pos_weight=config.position_weight,
                ori_weight=config.rotation_weight,
            ),
            libraries.pyroki.costs.rest_cost(variable, start, config.rest_weight),
            box_cost(variable, low, high),
        ]
        solution = (
            jaxls.LeastSquaresProblem(costs, [variable])
            .analyze()
            .solve(
                jaxls.VarValues.make([variable.with_value(start)]),
                verbose=False,
                linear_solver="dense_cholesky",
                termination=termination,
            )
        )
        q = jnp.clip(solution[variable], low, high)
        return (q, q, reference, lower, upper), (q, low, high)

    def chunk(
        robot: Any, poses: Any, steps: Any, anchored: Any, seed: Any, reference: Any, lower: Any, upper: Any
    ) -> Any:
        first = (seed, seed, reference, lower, upper)
        return jax.lax.scan(functools.partial(frame, robot), first, (poses, steps, anchored))[1]

    return jax.jit(chunk)


def _unit(poses: Float64) -> Float64:
    """Return the poses [T, 7] with unit quaternions."""
    unit = poses.copy()
    unit[:, 3:] /= np.linalg.norm(unit[:, 3:], axis=-1, keepdims=True)
    return unit


def _float32(array: Float64) -> Any:
    return np.asarray(array, np.float32)
