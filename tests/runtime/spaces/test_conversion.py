from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from robots import Robot, load_robot
from runtime.core.errors import PolicyError, SetupError
from runtime.core.pose_format import PoseFormat
from runtime.core.types import ActionChunk, Observation
from runtime.kinematics.base import IkFlag
from runtime.kinematics.compiled import CompiledKinematics
from runtime.spaces.conversion import ActionSpaces, ChunkStart, CommandRows
from runtime.spaces.pose_rows import PoseRows
from tests.examples import some
from tests.runtime.odd_robot import odd_robot

ROBOT = load_robot("agilex_piper")
SPACES = ActionSpaces(ROBOT, CompiledKinematics(ROBOT), 30.0)
START = np.array(
    [0.1, 1.2, -1.0, 0.3, 0.4, 0.2, 0.03, -0.2, 0.9, -0.8, 0.1, -0.4, 0.5, 0.08], dtype=np.float32
)


def seen(qpos: np.ndarray = START, eef: np.ndarray | None = None) -> Observation:
    return Observation(1, 0.0, {}, np.asarray(qpos, np.float32), {}, eef=eef)


def commanded(chunk: ActionChunk, qpos: np.ndarray = START) -> CommandRows:
    return SPACES.to_command(chunk, seen(qpos))


def path(rows: int, step: float = 0.01) -> np.ndarray:
    moving = np.ones(14) * step
    moving[[6, 13]] = 0.001
    return (START + np.arange(rows)[:, None] * moving).astype(np.float32)


def test_joint_rows_pass_as_they_are_in_float64() -> None:
    rows = path(5)
    made = commanded(ActionChunk(rows))
    commands = made.rows
    assert made.ik_result is None
    assert made.source_rows.tolist() == [0, 1, 2, 3, 4]
    assert commands.dtype == np.float64
    np.testing.assert_array_equal(commands.astype(np.float32), rows)
    commands[0] = 0.0
    np.testing.assert_array_equal(rows[0], START)


def test_eef_rows_become_the_joints_that_they_were_made_of() -> None:
    rows = path(20)
    made = commanded(ActionChunk(SPACES.eef_of(rows), space="eef"))
    assert made.ik_result is not None
    assert made.ik_result.reached.all()
    assert made.rows.dtype == np.float64
    np.testing.assert_allclose(made.rows, rows, atol=1e-4)


def test_grippers_are_taken_from_the_chunk_also_outside_their_range() -> None:
    eef = SPACES.eef_of(path(3))
    eef[:, 7] = [0.0, -0.003, 0.103]
    eef[:, 15] = 0.05
    commands = commanded(ActionChunk(eef, space="eef")).rows
    np.testing.assert_array_equal(commands[:, 6], eef[:, 7].astype(np.float64))
    np.testing.assert_array_equal(commands[:, 13], eef[:, 15].astype(np.float64))


def test_quaternions_that_are_not_quite_unit_or_of_the_other_sign_give_the_same_joints() -> None:
    eef = SPACES.eef_of(path(6))
    sloppy = eef.copy()
    sloppy[:, 3:7] *= 1.03
    sloppy[::2, 11:15] *= -1.0
    expected = commanded(ActionChunk(eef, space="eef")).rows
    made = commanded(ActionChunk(sloppy, space="eef"))
    assert made.ik_result is not None
    assert made.ik_result.reached.all()
    np.testing.assert_allclose(made.rows, expected, atol=1e-5)


def test_velocity_limits_hold_from_one_control_period_to_the_next_whatever_the_chunks_rate() -> None:
    there = START.copy()
    there[0] += 1.0
    eef = SPACES.eef_of(np.stack([START, there]))
    slow = commanded(ActionChunk(eef, space="eef", rate=2.0))
    fast = commanded(ActionChunk(eef, space="eef"))
    assert slow.source_rows.tolist() == [0] * 15 + [1]
    assert slow.rows[15, 0] - slow.rows[0, 0] == pytest.approx(1.0, abs=1e-3)
    for made in (slow, fast):
        assert np.all(np.abs(np.diff(made.rows, axis=0)) <= ROBOT.velocity / 30 + 1e-9)


def test_a_pose_that_cannot_be_reached_is_reported_arm_by_arm() -> None:
    eef = SPACES.eef_of(path(4))
    eef[2:, 8] += 2.0
    result = commanded(ActionChunk(eef, space="eef")).ik_result
    assert result is not None
    np.testing.assert_array_equal(result.reached, [[True, True], [True, True], [True, False], [True, False]])
    assert (result.position_error[2:, 1] > 1.0).all()


@pytest.mark.parametrize(
    ("actions", "space", "said"),
    [
        (np.zeros((5, 16)), "joint", r"joint actions of shape \(5, 16\); agilex_piper takes \[H, 14\]"),
        (np.zeros((5, 14)), "eef", r"eef actions of shape \(5, 14\); agilex_piper takes \[H, 16\]"),
        (np.zeros((0, 14)), "joint", "at least one row"),
        (np.zeros(14), "joint", r"shape \(14,\)"),
        (
            np.zeros((2, 16)),
            "eef",
            "no orientation for left_arm in row 0: qw, qx, qy, qz = 0, 0, 0, 0; allowed",
        ),
    ],
)
def test_an_answer_of_the_wrong_shape_or_without_direction_is_named(
    actions: np.ndarray, space: str, said: str
) -> None:
    with pytest.raises(PolicyError, match=said):
        commanded(ActionChunk(actions.astype(np.float32), space=space))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("space", "column", "name"), [("joint", 9, "right_arm.joint2"), ("eef", 4, "left_arm.qx")]
)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_number_that_is_not_finite_is_named(space: str, column: int, name: str, value: float) -> None:
    rows = path(4) if space == "joint" else SPACES.eef_of(path(4))
    rows[2, column] = value
    with pytest.raises(PolicyError, match=f"answered with {value} for {name} in row 2"):
        commanded(ActionChunk(rows, space=space))  # type: ignore[arg-type]


def test_a_rate_that_is_no_rate_is_refused() -> None:
    with pytest.raises(SetupError, match=r"control_rate = 0\.0 Hz; allowed: above zero"):
        ActionSpaces(ROBOT, CompiledKinematics(ROBOT), 0.0)


def test_eef_of_one_vector_is_pose_and_gripper_of_each_arm() -> None:
    vector = SPACES.eef_of(START)
    poses = CompiledKinematics(ROBOT).forward(START.astype(np.float64))
    assert vector.dtype == np.float32
    assert vector.shape == (16,)
    np.testing.assert_array_equal(vector.reshape(2, 8)[:, :7], poses.astype(np.float32))
    np.testing.assert_array_equal(vector[[7, 15]], START[[6, 13]])


def turning(rows: int) -> np.ndarray:
    """Joints whose first arm's quaternion passes through w = 0."""
    q = np.repeat(np.array([[-2.6, 2.4, -1.2, 1.7, 1.2, -2.09, 0.0] * 2]), rows, axis=0)
    q[:, 0] = np.linspace(-2.618, 2.618, rows)
    q[:, 5] = np.linspace(-2.09, 2.09, rows)
    return q


def test_a_stream_of_eef_vectors_never_changes_the_sign_of_a_quaternion() -> None:
    q = turning(200)
    plain = np.stack([SPACES.eef_of(row) for row in q])
    assert ((plain[1:, 3:7] * plain[:-1, 3:7]).sum(axis=1) < 0).any()
    rows = SPACES.eef_of(q)
    for arm in (0, 8):
        quaternions = rows[:, arm + 3 : arm + 7]
        assert ((quaternions[1:] * quaternions[:-1]).sum(axis=1) > 0.9).all()
    single = SPACES.eef_of(q[0])
    for row, expected in zip(q[1:], rows[1:], strict=True):
        single = SPACES.eef_of(row, previous=single)
        np.testing.assert_allclose(single, expected, atol=1e-6)


def test_rows_continue_what_came_before_them() -> None:
    q = turning(200)
    whole = SPACES.eef_of(q)
    np.testing.assert_allclose(SPACES.eef_of(q[150:], previous=whole[149]), whole[150:], atol=1e-6)


# Chunks that are relative to their observation

JOINTS = [dim for dim in range(14) if dim not in ROBOT.gripper_dims]
modes = st.sampled_from(["relative", "delta"])


def relative_joints(rows: np.ndarray, mode: str) -> np.ndarray:
    before = (
        np.broadcast_to(START, rows.shape) if mode == "relative" else np.concatenate([START[None], rows[:-1]])
    )
    made = rows.copy()
    made[:, JOINTS] -= before[:, JOINTS]
    return made


def relative_poses(rows: np.ndarray, start: np.ndarray, mode: str, frame: str) -> np.ndarray:
    """What `rows` [T, 16] are from `start`, by scipy and not by the code under test."""
    made, before = rows.copy(), start
    for row, wanted in zip(made, rows, strict=True):
        for arm in (slice(0, 8), slice(8, 16)):
            pose, goal = before[arm], wanted[arm]
            first, last = (Rotation.from_quat(v[3:7], scalar_first=True) for v in (pose, goal))
            offset = goal[:3] - pose[:3]
            turn = first.inv() * last if frame == "tool" else last * first.inv()
            row[arm][:3] = first.inv().apply(offset) if frame == "tool" else offset
            row[arm][3:7] = turn.as_quat(scalar_first=True)
        before = before if mode == "relative" else wanted
    return made


@given(modes, st.integers(1, 12), st.floats(-0.02, 0.02))
def test_relative_joints_are_added_to_the_observed_ones_and_grippers_are_not(
    mode: str, count: int, step: float
) -> None:
    rows = path(count, step)
    made = commanded(ActionChunk(relative_joints(rows, mode), mode=mode))  # type: ignore[arg-type]
    np.testing.assert_allclose(made.rows, rows, atol=1e-5)
    np.testing.assert_array_equal(made.rows[:, ROBOT.gripper_dims], rows[:, ROBOT.gripper_dims])


@settings(max_examples=some(20))
@given(modes, st.sampled_from(["base", "tool"]), st.integers(1, 6), st.floats(-0.02, 0.02))
def test_relative_poses_come_back_to_the_absolute_ones_they_were_made_of(
    mode: str, frame: str, count: int, step: float
) -> None:
    rows = path(count, step)
    offsets = relative_poses(SPACES.eef_of(rows), SPACES.eef_of(START), mode, frame)
    made = commanded(ActionChunk(offsets, space="eef", mode=mode, frame=frame))  # type: ignore[arg-type]
    assert made.ik_result is not None
    assert made.ik_result.reached.all()
    np.testing.assert_allclose(made.rows, rows, atol=1e-3)


def test_poses_are_relative_to_the_measured_ones_where_the_robot_measures_them() -> None:
    measured = SPACES.eef_of(START)
    measured[2] += 0.01
    rest = np.zeros((1, 16), np.float32)
    rest[:, [3, 11]] = 1.0
    chunk = ActionChunk(rest, space="eef", mode="relative")
    raised = SPACES.to_command(chunk, seen(eef=measured)).rows
    assert SPACES.eef_of(raised)[0, 2] == pytest.approx(measured[2], abs=1e-3)
    still = SPACES.to_command(chunk, seen()).rows
    np.testing.assert_allclose(still[0, JOINTS], START[JOINTS], atol=1e-4)


def test_an_observation_without_a_pose_is_no_ground_for_a_relative_chunk() -> None:
    rest = np.zeros((1, 16), np.float32)
    rest[:, [3, 11]] = 1.0
    chunk = ActionChunk(rest, space="eef", mode="delta")
    with pytest.raises(
        PolicyError, match="delta to an observation with no orientation for left_arm in row 0"
    ):
        SPACES.to_command(chunk, seen(eef=np.zeros(16, np.float32)))


# Rates


@settings(max_examples=some(20))
@given(st.integers(1, 6), st.sampled_from([7.5, 10.0, 30.0, 50.0]))
def test_poses_of_another_rate_stay_on_the_straight_way_between_rows(count: int, rate: float) -> None:
    ends = SPACES.eef_of(path(count)).astype(np.float64)
    made = commanded(ActionChunk(ends.astype(np.float32), space="eef", rate=rate))
    assert made.ik_result is not None
    assert made.ik_result.reached.all()
    assert len(made.rows) == len(made.source_rows) == int((count - 1) * 30.0 / rate + 1e-9) + 1
    between = SPACES.eef_of(made.rows)[:, :3]
    meant = np.arange(len(made.rows)) * rate / 30.0
    for axis in range(3):
        straight = np.interp(meant, np.arange(count), ends[:, axis])
        np.testing.assert_allclose(between[:, axis], straight, atol=1e-3)


def test_a_delta_is_summed_at_the_policys_rate_before_it_is_resampled() -> None:
    steps = np.zeros((3, 14), np.float32)
    steps[:, 0] = 0.1
    made = commanded(ActionChunk(steps, mode="delta", rate=15.0))
    np.testing.assert_allclose(made.rows[:, 0] - START[0], [0.1, 0.15, 0.2, 0.25, 0.3], atol=1e-6)
    assert made.source_rows.tolist() == [0, 0, 1, 1, 2]


# Grippers that know two values, joints without end

SWITCHED = replace(
    ROBOT,
    groups=tuple(
        replace(group, gripper=replace(group.gripper, binary=True, threshold=0.05, hysteresis=0.05))
        for group in ROBOT.groups
    ),
)
ENDLESS_DIM = 5
LOWER, UPPER = ROBOT.lower.copy(), ROBOT.upper.copy()
LOWER[ENDLESS_DIM], UPPER[ENDLESS_DIM] = -np.inf, np.inf
ENDLESS = replace(ROBOT, lower=LOWER, upper=UPPER)


@settings(max_examples=some(20))
@given(st.lists(st.sampled_from([0.0, 0.1]), min_size=1, max_size=5), st.sampled_from(["joint", "eef"]))
def test_binary_grippers_stay_binary_at_every_rate(values: list[float], space: str) -> None:
    spaces = ActionSpaces(SWITCHED, CompiledKinematics(SWITCHED), 30.0)
    rows = path(len(values), 0.0)
    rows[:, 6] = values
    given_ = rows if space == "joint" else spaces.eef_of(rows)
    made = spaces.to_command(ActionChunk(given_, space=space, rate=12.0), seen())  # type: ignore[arg-type]
    np.testing.assert_array_equal(made.rows[:, 6].astype(np.float32), rows[made.source_rows, 6])


@given(st.floats(-20, 20), st.integers(-3, 3), st.integers(1, 8))
def test_a_joint_without_end_goes_on_from_where_it_was_seen(at: float, turns: int, count: int) -> None:
    spaces = ActionSpaces(ENDLESS, CompiledKinematics(ENDLESS), 30.0)
    start = START.copy()
    start[ENDLESS_DIM] = at
    way = start[ENDLESS_DIM] + 0.3 * np.arange(count, dtype=np.float32)
    rows = path(count, 0.0)
    rows[:, ENDLESS_DIM] = (way + np.pi) % (2 * np.pi) - np.pi + 2 * np.pi * turns
    made = spaces.to_command(ActionChunk(rows, rate=15.0), seen(start))
    np.testing.assert_allclose(made.rows[::2, ENDLESS_DIM], way, atol=1e-4)
    assert np.all(np.abs(np.diff(made.rows[:, ENDLESS_DIM])) <= 0.16)


# Poses as policies write them


FORMATS = [
    PoseFormat(orientation="xyzw"),
    PoseFormat(orientation="euler", euler_order="ZYX", degrees=True),
    PoseFormat(orientation="euler", euler_order="xzx"),
    PoseFormat(orientation="rotation_vector"),
    PoseFormat(orientation="6d", sixd="rows", frame="world"),
    PoseFormat(orientation="6d", frame="world"),
]


def written(
    spaces: ActionSpaces, robot: Robot, pose: PoseFormat, rows: np.ndarray, at: np.ndarray
) -> np.ndarray:
    """Joint rows [T, D] as a policy of that format writes them; what it does not write stands as in `at` [T, D]."""
    vectors = spaces.vectors(rows.astype(np.float64))
    return PoseRows(pose, robot).encode(vectors, at.astype(np.float64))


@pytest.mark.parametrize("pose", FORMATS, ids=str)
def test_rows_in_any_format_become_the_joints_that_they_were_made_of(pose: PoseFormat) -> None:
    rows = path(20)
    actions = written(SPACES, ROBOT, pose, rows, START[None]).astype(np.float32)
    made = commanded(ActionChunk(actions, space="eef", pose=pose))
    assert made.ik_result is not None
    assert made.ik_result.reached.all()
    np.testing.assert_allclose(made.rows, rows, atol=1e-3)


def offsets(rows: np.ndarray, mode: str, frame: str, pose: PoseFormat) -> np.ndarray:
    """Rows [T, W]: what joint rows are relative to START, in the axes of `pose.frame`, by scipy."""
    declared = PoseRows(pose, ROBOT).frame
    everything = declared.express(
        SPACES.vectors(np.stack([START, *rows]).astype(float)), START[None].astype(float)
    )
    flat = everything.reshape(len(everything), 16)
    moves = relative_poses(flat[1:], flat[0], mode, frame).reshape(-1, 2, 8)
    there = pose.model_copy(update={"frame": ""})
    return PoseRows(there, ROBOT).encode(moves, START[None].astype(float))


@pytest.mark.parametrize("pose", FORMATS, ids=str)
@pytest.mark.parametrize("mode", ["relative", "delta"])
@pytest.mark.parametrize("frame", ["base", "tool"])
def test_offsets_in_any_format_lie_along_the_declared_frame_or_the_tool(
    pose: PoseFormat, mode: str, frame: str
) -> None:
    rows = path(8)
    actions = offsets(rows, mode, frame, pose).astype(np.float32)
    made = commanded(ActionChunk(actions, space="eef", mode=mode, frame=frame, pose=pose))  # type: ignore[arg-type]
    assert made.ik_result is not None
    assert made.ik_result.reached.all()
    np.testing.assert_allclose(made.rows, rows, atol=2e-3)


def test_rows_without_grippers_leave_them_as_they_are_commanded() -> None:
    pose = PoseFormat(orientation="6d", gripper=False)
    actions = written(SPACES, ROBOT, pose, path(4), START[None]).astype(np.float32)
    chunk = ActionChunk(actions, space="eef", pose=pose)
    np.testing.assert_array_equal(commanded(chunk).rows[:, [6, 13]], np.tile(START[[6, 13]], (4, 1)))
    told = START.astype(np.float64) + 0.01
    made = SPACES.to_command(chunk, seen(), ChunkStart(told, told)).rows
    np.testing.assert_array_equal(made[:, [6, 13]], np.tile(told[[6, 13]], (4, 1)))


@pytest.mark.parametrize(
    ("pose", "shape", "said"),
    [
        (PoseFormat(orientation="6d"), (5, 16), r"\(5, 16\); agilex_piper takes \[H, 20\]"),
        (
            PoseFormat(orientation="6d"),
            (5, 20),
            "no orientation for left_arm in row 0: ax, ay, az, bx, by, bz",
        ),
    ],
)
def test_rows_that_are_not_of_the_format_are_named(pose: PoseFormat, shape: Any, said: str) -> None:
    with pytest.raises(PolicyError, match=said):
        commanded(ActionChunk(np.zeros(shape, np.float32), space="eef", pose=pose))


def test_a_number_that_is_not_finite_is_named_as_the_format_names_it() -> None:
    actions = np.zeros((3, 12), np.float32)
    actions[1, 9] = np.nan
    pose = PoseFormat(orientation="rotation_vector", gripper=False)
    with pytest.raises(PolicyError, match=r"nan for right_arm\.rx in row 1"):
        commanded(ActionChunk(actions, space="eef", pose=pose))


# Where a chunk takes over


def leap(rows: int, by: float = 0.6) -> ActionChunk:
    """Poses that begin far from START on the first joint, and stay there."""
    there = START.copy()
    there[0] += by
    return ActionChunk(SPACES.eef_of(np.tile(there, (rows, 1))), space="eef")


def test_from_where_it_takes_over_no_joint_is_faster_than_it_may_be() -> None:
    told = START.astype(np.float64).copy()
    told[0] += 0.1
    made = SPACES.to_command(leap(20), seen(), ChunkStart(told, told, 4))
    step = ROBOT.velocity[0] / 30
    np.testing.assert_allclose(made.rows[:4, 0], START[0] + 0.6, atol=1e-3)  # stale: nobody executes them
    assert made.rows[4, 0] == pytest.approx(told[0] + step, abs=1e-9)
    assert np.all(np.abs(np.diff(made.rows[4:], axis=0)) <= ROBOT.velocity / 30 + 1e-9)
    assert made.rows[-1, 0] == pytest.approx(START[0] + 0.6, abs=1e-3)
    assert made.ik_result is not None
    assert made.ik_result.flags[4, 0] & IkFlag.AT_VELOCITY
    assert made.ik_result.flags[4, 0] & IkFlag.OVER_TOLERANCE


def test_where_the_policy_means_to_begin_is_not_hidden_by_how_fast_the_robot_is() -> None:
    made = commanded(leap(5))
    assert made.rows[0, 0] == pytest.approx(START[0] + ROBOT.velocity[0] / 30, abs=1e-6)
    assert made.intended_start[0] == pytest.approx(START[0] + 0.6, abs=1e-3)
    stale = SPACES.to_command(leap(5), seen(), ChunkStart(START.astype(float), START.astype(float), 2))
    assert stale.intended_start[0] == pytest.approx(START[0] + 0.6, abs=1e-3)
    np.testing.assert_array_equal(commanded(ActionChunk(path(3))).intended_start, path(3)[0].astype(float))


def test_a_chunk_whose_rows_are_all_stale_is_solved_all_the_same() -> None:
    made = SPACES.to_command(leap(5), seen(), ChunkStart(START.astype(float), START.astype(float), 50))
    assert made.rows.shape == (5, 14)


# Robots with more than two arms that have grippers


@pytest.fixture(scope="module")
def odd(tmp_path_factory: pytest.TempPathFactory) -> tuple[Robot, ActionSpaces]:
    robot = odd_robot(tmp_path_factory.mktemp("robots"))
    return robot, ActionSpaces(robot, CompiledKinematics(robot), 30.0)


def test_an_arm_without_a_gripper_has_a_0_that_is_nobodys(odd: tuple[Robot, ActionSpaces]) -> None:
    robot, spaces = odd
    home = robot.poses["home"]
    vector = spaces.eef_of(home)
    assert vector.shape == (16,)
    assert vector[7] == 0.0
    assert vector[15] == np.float32(home[14])
    rows = np.tile(vector, (3, 1))
    rows[:, 7] = 9.0
    made = spaces.to_command(ActionChunk(rows, space="eef"), seen(home))
    np.testing.assert_allclose(made.rows, np.tile(home, (3, 1)), atol=1e-5)
    assert made.rows[0, 14] == vector[15]


def test_what_rows_say_nothing_of_is_held_where_it_is_commanded(odd: tuple[Robot, ActionSpaces]) -> None:
    robot, spaces = odd
    home = robot.poses["home"]
    told = home + 0.01
    rows = np.tile(spaces.eef_of(home), (3, 1))
    made = spaces.to_command(ActionChunk(rows, space="eef"), seen(home), ChunkStart(told, told)).rows
    np.testing.assert_array_equal(made[:, [0, 1, 15, 16]], np.tile(told[[0, 1, 15, 16]], (3, 1)))


@pytest.mark.parametrize("mode", ["absolute", "relative", "delta"])
def test_joints_that_follow_the_poses_are_commanded_with_them(
    odd: tuple[Robot, ActionSpaces], mode: str
) -> None:
    robot, spaces = odd
    home = robot.poses["home"]
    pose = PoseFormat(orientation="rotation_vector", groups=["hand", "neck"])
    rows = np.tile(home, (4, 1))
    rows[:, 0] += [0.1, 0.2, 0.3, 0.4]
    rows[:, 15] += [0.5, 0.5, 0.5, 0.6]
    rows[:, 16] = [1.0, 1.0, 0.0, 0.0]
    actions = written(spaces, robot, pose, rows, rows)
    if mode != "absolute":
        before = np.tile(home, (4, 1)) if mode == "relative" else np.stack([home, *rows[:-1]])
        actions[:, :14] = 0.0  # no move of the arms
        actions[:, [6, 13]] = [0.0, home[14]]
        actions[:, 14:] -= np.where(np.arange(4) == 1, 0.0, before[:, [15, 16, 0, 1]])
    chunk = ActionChunk(actions.astype(np.float32), space="eef", mode=mode, pose=pose, rate=15.0)  # type: ignore[arg-type]
    made = spaces.to_command(chunk, seen(home))
    np.testing.assert_allclose(made.rows[::2], rows, atol=1e-5)
    np.testing.assert_allclose(made.rows[1::2, 0], [home[0] + at for at in (0.15, 0.25, 0.35)], atol=1e-6)
    assert made.rows[:, 16].tolist() == [1, 1, 1, 1, 0, 0, 0]


TORSO = load_robot("r1_lite", ["left_arm", "right_arm", "torso"])
CARRIED = ActionSpaces(TORSO, CompiledKinematics(TORSO), 30.0)
STANDS = TORSO.poses["ready"] if "ready" in TORSO.poses else TORSO.poses["home"]


@pytest.mark.parametrize("frame", ["", "torso_link3"])
@pytest.mark.parametrize("appended", [True, False])
def test_arms_reach_their_poses_while_rows_move_the_torso_that_carries_them(
    frame: str, appended: bool
) -> None:
    pose = PoseFormat(orientation="6d", frame=frame, groups=["torso"] if appended else [])
    rows = np.tile(STANDS, (6, 1))
    rows[:, 0] += 0.02 * np.arange(6)
    if appended:
        rows[:, TORSO.group("torso").slice] += 0.01 * np.arange(6)[:, None]
    actions = written(CARRIED, TORSO, pose, rows, rows)
    made = CARRIED.to_command(ActionChunk(actions.astype(np.float32), space="eef", pose=pose), seen(STANDS))
    assert made.ik_result is not None
    assert made.ik_result.reached.all()
    np.testing.assert_allclose(CARRIED.vectors(made.rows)[..., :3], CARRIED.vectors(rows)[..., :3], atol=1e-3)
    np.testing.assert_allclose(
        made.rows[:, TORSO.group("torso").slice], rows[:, TORSO.group("torso").slice], atol=1e-5
    )


# Measured poses


def test_how_far_measured_poses_are_from_those_of_the_joints_is_said_of_the_worst_arm() -> None:
    measured = SPACES.eef_of(START)
    assert SPACES.pose_mismatch(measured, START) == ""
    measured[3:7] *= -1.0
    assert SPACES.pose_mismatch(measured, START) == ""
    turn = Rotation.from_quat(measured[11:15], scalar_first=True) * Rotation.from_rotvec([0, 0, 0.5])
    measured[11:15] = turn.as_quat(scalar_first=True)
    said = SPACES.pose_mismatch(measured, START)
    assert "right_arm 0 mm and 29 degrees from where its joints have gripper_base in base_link" in said
    with pytest.raises(PolicyError, match="the robot measured no orientation for left_arm"):
        SPACES.pose_mismatch(np.zeros(16), START)
