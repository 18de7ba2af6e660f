"""Conversion of chunks from a policy's action space to joint commands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robots import Robot
from robots.rotations import quaternion_of_matrix, transform_of
from runtime.core.errors import NotFiniteError, SetupError, ShapeError
from runtime.core.pose_format import CANONICAL, PoseFormat
from runtime.core.types import EEF_WIDTH, ActionChunk, Float64, Observation
from runtime.kinematics.base import IkResult, Kinematics
from runtime.motion.resampling import resample, resampled_length
from runtime.spaces.binary_grippers import binary_grippers_of
from runtime.spaces.end_effectors import EndEffectors
from runtime.spaces.pose_rows import PoseRows, continuous_quaternions
from runtime.spaces.relative_poses import to_absolute

_GRIPPER = EEF_WIDTH - 1
_SAME_PLACE, _SAME_TURN = 0.02, 5.0  # [m, degrees] tolerance between measured and computed poses
_LONGEST = 2000  # rows per chunk, as received and at control rate: IK is sequential, and the ring to control is finite


@dataclass(frozen=True, slots=True)
class ChunkStart:
    """Point at which a chunk takes over from the present command; vectors float64 [D].

    `commanded` is the present command. Grippers and joints that the chunk's rows do not contain stay there. `first_row`
    is the first row that will be executed, and `previous_command` the command of the step before it, or the measured
    position of a robot at rest. From `first_row` on, the solved joints respect their velocity limits.
    """

    commanded: Float64
    previous_command: Float64
    first_row: int = 0


@dataclass(frozen=True, slots=True)
class CommandRows:
    """Chunk in command space at control rate.

    `rows` float64 [H', D] are absolute joint targets; `source_rows` int64 [H'] is the index of the policy's row from
    which each was made. `ik_result` has the errors of the solved poses and `targets` [H', arms, 7] the poses; both are
    None for a joint chunk. `first` [D] are the joints of the first pose without velocity limits, None if rows[0]
    already has them.
    """

    rows: Float64
    source_rows: NDArray[np.int64]
    ik_result: IkResult | None
    first: Float64 | None = None
    targets: Float64 | None = None

    @property
    def intended_start(self) -> Float64:
        """Joints at which the policy intends to begin [D], even if the robot cannot reach them in one step."""
        return self.rows[0] if self.first is None else self.first


class ActionSpaces(EndEffectors):
    """Action spaces of a robot: joint rows [H, D], and pose rows, which inverse kinematics converts to joints.

    An arm's vector is x, y, z [m], unit quaternion w, x, y, z, gripper, in the arm's declared frame, whatever the
    format of the rows. `control_rate` [Hz] is the rate of commands, and of chunks that declare no rate.
    """

    def __init__(self, robot: Robot, kinematics: Kinematics, control_rate: float) -> None:
        if not control_rate > 0:
            raise SetupError(f"control_rate = {control_rate} Hz; allowed: above zero")
        super().__init__(robot, kinematics)
        self.arm_names = tuple(arm.name for arm in robot.arms)
        self._robot = robot
        self._kinematics = kinematics
        self._control_rate = control_rate
        arms = robot.arms
        self._all = np.arange(robot.dim)
        self._speeds = list(robot.speed_dims)
        self._moving = np.setdiff1d(self._all, [*robot.gripper_dims, *self._speeds])
        solved = np.concatenate([np.zeros(0, np.intp), *(arm.joint_dims for arm in arms)])
        self._still = np.setdiff1d(self._all, solved)
        self._wrapping = np.flatnonzero(np.isinf(robot.lower) & np.isinf(robot.upper))
        self._quaternions = [EEF_WIDTH * arm + 3 for arm in range(self._count)]
        pairs = zip(self._gripped, self._grippers, strict=True)
        self._gripper_columns = {dim: EEF_WIDTH * arm + _GRIPPER for arm, dim in pairs}
        self._switches = binary_grippers_of(robot)
        self._layout: PoseRows | None = None

    def to_command(
        self, chunk: ActionChunk, observation: Observation, onset: ChunkStart | None = None
    ) -> CommandRows:
        """Convert a chunk that was computed from `observation` to absolute joint rows at control rate.

        The steps, in order:

        * Check the rows, and decode poses from their format.
        * Make relative rows absolute: joints with the observed joints, poses with the observed poses or, without these,
          with the poses of the observed joints, in the declared frame.
        * Snap binary grippers, with hysteresis from the present command. Other grippers are copied.
        * Resample to the control rate.
        * Solve poses: row 0 from the observed joints, each further row from its predecessor. Solved joints respect
          velocity limits from `onset` on; without `onset` the robot is assumed to be at rest at the observed joints.
        * Unwrap joints without limits from the observed joints on.

        Joints that the rows do not contain hold `onset.commanded`.

        Raises:
            PolicyError: Wrong width, a number that is not finite, or numbers that determine no orientation.
        """
        qpos = np.asarray(observation.qpos, dtype=np.float64)
        rate = chunk.rate or self._control_rate
        onset = onset or ChunkStart(qpos, qpos)
        if chunk.space == "joint":
            rows = self._check_rows(chunk, rate, self._robot.dim, self._robot.joint_names)
            rows = self._absolute_joints(rows, chunk, qpos, self._all)
            snapped = self._snap_grippers(rows, {int(dim): int(dim) for dim in self._all}, onset, rate)
            rows, source = resample(rows, rate, self._control_rate, snapped)
            return CommandRows(rows, source, None)
        layout = self._layout_of(chunk.pose)
        rows = self._check_rows(chunk, rate, layout.width, layout.names)
        rows = self._absolute_poses(rows, layout, chunk, observation)
        following = {int(dim): self._count * EEF_WIDTH + place for place, dim in enumerate(layout.dims)}
        snapped = self._snap_grippers(rows, self._gripper_columns | following, onset, rate)
        rows, source = resample(rows, rate, self._control_rate, snapped, self._quaternions)
        onset = self._unwrap_start(onset, qpos)
        return self._solved(rows, source, layout, qpos, onset)

    def _snap_grippers(
        self, rows: Float64, columns: Mapping[int, int], onset: ChunkStart, rate: float
    ) -> list[int]:
        """Snap the binary grippers in `rows` [H, W] in place; return their columns.

        `columns` maps a dimension of the robot's vector to its column in the rows. The hysteresis starts from the
        present command twice: at row 0, and at the first row that will be executed, because that row follows the
        present command and not the rows before it.
        """
        first = int(onset.first_row * rate / self._control_rate + 1e-9)
        snapped = [(switch, columns[switch.dim]) for switch in self._switches if switch.dim in columns]
        for switch, column in snapped:
            for part in (slice(0, first), slice(first, None)):
                rows[part, column] = switch.snap_sequence(
                    rows[part, column], float(onset.commanded[switch.dim])
                )
        return [column for _, column in snapped]

    def pose_mismatch(self, measured: ArrayLike, q: ArrayLike) -> str:
        """Describe how much measured poses [8 * arms] differ from those of joints `q` [D], for the worst arm; "" if
        equal.
        """
        joints = np.asarray(q, dtype=np.float64)
        expected = self.vectors(joints)
        poses = np.asarray(measured, dtype=np.float64).reshape(self._count, EEF_WIDTH)
        poses = self._layout_of(None).normalize_quaternions(poses[None])[0]
        metres = np.linalg.norm(poses[:, :3] - expected[:, :3], axis=-1)
        cosines = np.abs(np.sum(poses[:, 3:7] * expected[:, 3:7], axis=-1))
        degrees = np.degrees(2.0 * np.arccos(np.clip(cosines, 0.0, 1.0)))
        worst = int(np.argmax(metres / _SAME_PLACE + degrees / _SAME_TURN))
        if metres[worst] <= _SAME_PLACE and degrees[worst] <= _SAME_TURN:
            return ""
        arm = self._robot.arms[worst]
        return (
            f"the robot measures the pose of {arm.name} {1000 * metres[worst]:.0f} mm and {degrees[worst]:.0f} degrees "
            f"from where its joints have {arm.eef_link} in {arm.frame}; allowed: {1000 * _SAME_PLACE:g} mm and "
            f"{_SAME_TURN:g} degrees: another frame or another link"
        )

    def _layout_of(self, pose: PoseFormat | None) -> PoseRows:
        """Return the row layout of a pose format; the last layout is cached, because a policy uses a single format."""
        requested = CANONICAL if pose is None else pose
        if self._layout is None or self._layout.pose != requested:
            self._layout = PoseRows(requested, self._robot, "the policy's pose format")
        return self._layout

    def _absolute_joints(
        self, rows: Float64, chunk: ActionChunk, qpos: Float64, dims: NDArray[np.intp]
    ) -> Float64:
        """Return rows [H, n] of the joints `dims` as absolute, unwrapped; grippers are absolute in all modes."""
        rows = rows.copy()
        if chunk.mode != "absolute":
            moving = np.isin(dims, self._moving)
            moves = rows[:, moving]
            moved = moves if chunk.mode == "relative" else moves.cumsum(axis=0)
            rows[:, moving] = qpos[dims[moving]] + moved
        return self._unwrapped(rows, qpos, dims)

    def _absolute_poses(
        self, rows: Float64, layout: PoseRows, chunk: ActionChunk, observation: Observation
    ) -> Float64:
        """Return rows [H, 8 * arms + n]: absolute arm vectors in each arm's own frame, then n absolute joint values.

        The joint values are those that follow the poses in each row.
        """
        qpos = np.asarray(observation.qpos, dtype=np.float64)
        vectors, joints = layout.decode(rows)
        joints = self._absolute_joints(joints, chunk, qpos, layout.dims)
        at = qpos[None]
        if chunk.mode != "absolute":
            start = layout.frame.express(self._reference_vectors(layout, chunk, observation), at)[0]
            vectors = to_absolute(vectors, start, chunk.mode, chunk.frame)
        elif len(layout.dims):
            at = self._with_joints(qpos, layout, joints)
        if not layout.frame.own:
            vectors = layout.frame.resolve(vectors, at)
            vectors[..., 3:7] = continuous_quaternions(vectors[..., 3:7])
        return np.concatenate([vectors.reshape(len(rows), -1), joints], axis=1)

    def _reference_vectors(self, layout: PoseRows, chunk: ActionChunk, observation: Observation) -> Float64:
        """Return the vectors [1, arms, 8] to which a chunk is relative."""
        eef = self.eef_of(observation.qpos) if observation.eef is None else observation.eef
        vectors = np.asarray(eef, dtype=np.float64).reshape(1, self._count, EEF_WIDTH)
        return layout.normalize_quaternions(vectors, f"the chunk is {chunk.mode} to an observation with")

    def _with_joints(self, qpos: Float64, layout: PoseRows, joints: Float64) -> Float64:
        """Return vectors of the whole robot [H, D]: `qpos` [D] with some joints replaced.

        The joints that follow the poses in a row are taken from `joints` [H, n].
        """
        full = np.tile(qpos, (len(joints), 1))
        full[:, layout.dims] = joints
        return full

    def _solved(
        self, rows: Float64, source: NDArray[np.int64], layout: PoseRows, qpos: Float64, onset: ChunkStart
    ) -> CommandRows:
        poses = rows[:, : self._count * EEF_WIDTH].reshape(len(rows), self._count, EEF_WIDTH)
        joints = rows[:, self._count * EEF_WIDTH :]
        targets = self._compensate_carrier(poses[..., :_GRIPPER], layout, joints, qpos)
        row = min(onset.first_row, max(0, len(rows) - 1))
        solved = self._kinematics.solve(targets, qpos, 1.0 / self._control_rate, onset.previous_command, row)
        commands = self._assembled(solved.q, poses, layout, joints, onset)
        first = None
        if row == 0 and len(rows):  # velocity limits would hide that the chunk begins far away
            free = self._kinematics.solve(targets[:1], qpos)
            alone = self._assembled(free.q, poses[:1], layout, joints[:1], onset)
            first = self._unwrapped(alone, qpos, self._all)[0]
        return CommandRows(self._unwrapped(commands, qpos, self._all), source, solved, first, targets)

    def meet(self, made: CommandRows, row: int) -> tuple[IkResult, float]:
        """Solve the pose of row `row` again without velocity limits.

        Return the result, and its largest distance from that row's joints [rad].
        """
        assert made.ik_result is not None
        assert made.targets is not None
        free = self._kinematics.solve(made.targets[row : row + 1], made.ik_result.q[row])
        return free, float(np.abs(free.q[0] - made.ik_result.q[row]).max())

    def _assembled(
        self, solved: Float64, poses: Float64, layout: PoseRows, joints: Float64, onset: ChunkStart
    ) -> Float64:
        """Return rows of commands [H, D] from the solved arms, the grippers and the joints that follow the poses.

        All other joints hold the present command, and a base stops.
        """
        commands = solved.copy()
        commands[:, self._still] = onset.commanded[self._still]
        commands[:, self._speeds] = 0.0  # a base without commands in the rows stops
        if layout.pose.gripper:
            commands[:, self._grippers] = poses[:, self._gripped, _GRIPPER]
        commands[:, layout.dims] = joints
        return commands

    def _compensate_carrier(
        self, poses: Float64, layout: PoseRows, joints: Float64, qpos: Float64
    ) -> Float64:
        """Return poses [H, arms, 7] for a solver that assumes the arms' carrier (a torso) to be at `qpos`.

        If the rows move the carrier, each pose is moved in the opposite way, so that the solved joints are right when
        the carrier has moved.
        """
        compensated = poses
        for index, arm in enumerate(self._robot.arms):
            if arm.carrier is None or not np.isin(arm.carrier_dims, layout.dims).any():
                continue
            carrier = arm.carried(self._with_joints(qpos, layout, joints))
            target = arm.carried(qpos) @ np.linalg.inv(carrier) @ transform_of(poses[:, index])
            compensated = compensated.copy() if compensated is poses else compensated
            compensated[:, index, :3] = target[..., :3, 3]
            compensated[:, index, 3:] = quaternion_of_matrix(target[..., :3, :3])
        return compensated

    def _unwrap_start(self, onset: ChunkStart, qpos: Float64) -> ChunkStart:
        """Return `onset` with joints without limits shifted by whole turns to within half a turn of `qpos`."""

        def on_branch(joints: Float64) -> Float64:
            unwrapped = np.array(joints, dtype=np.float64)
            apart = unwrapped[self._wrapping] - qpos[self._wrapping]
            unwrapped[self._wrapping] -= 2 * np.pi * np.round(apart / (2 * np.pi))
            return unwrapped

        return ChunkStart(on_branch(onset.commanded), on_branch(onset.previous_command), onset.first_row)

    def _unwrapped(self, rows: Float64, qpos: Float64, dims: NDArray[np.intp]) -> Float64:
        """Return `rows` of the joints `dims`, changed so that joints without limits do not jump between rows.

        The first row of such a joint is within half a turn of `qpos`.
        """
        endless = np.flatnonzero(np.isin(dims, self._wrapping))
        turning = np.concatenate([qpos[dims[endless]][None], rows[:, endless]])
        rows[:, endless] = np.unwrap(turning, axis=0)[1:]
        return rows

    def _check_rows(self, chunk: ActionChunk, rate: float, width: int, names: tuple[str, ...]) -> Float64:
        rows = np.array(chunk.actions, dtype=np.float64)
        if rows.ndim != 2 or rows.shape[1] != width or not len(rows):
            raise ShapeError(
                f"the policy answered with {chunk.space} actions of shape {rows.shape}; "
                f"{self._robot.name} takes [H, {width}] with at least one row"
            )
        _check_length(len(rows), resampled_length(len(rows), rate, self._control_rate))
        wrong = np.argwhere(~np.isfinite(rows))
        if len(wrong):
            row, column = wrong[0]
            raise NotFiniteError(
                f"the policy answered with {rows[row, column]} for {names[column]} in row {row} "
                f"({len(wrong)} such numbers); allowed: finite numbers"
            )
        return rows


def _check_length(count: int, resampled: int) -> None:
    if max(count, resampled) > _LONGEST:
        at_rate = "" if resampled <= count else f", {resampled} at control rate"
        raise ShapeError(
            f"the policy answered with {count} rows{at_rate}; allowed: at most {_LONGEST} in one chunk"
        )
