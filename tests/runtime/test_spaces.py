from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from robots import load
from runtime.errors import PolicyError, SetupError
from runtime.kinematics.compiled import CompiledKinematics
from runtime.spaces import CommandRows, Spaces
from runtime.types import ActionChunk, Observation

ROBOT = load("agilex_piper")
SPACES = Spaces(ROBOT, CompiledKinematics(ROBOT), 30.0)
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
    assert made.solved is None
    assert made.source.tolist() == [0, 1, 2, 3, 4]
    assert commands.dtype == np.float64
    np.testing.assert_array_equal(commands.astype(np.float32), rows)
    commands[0] = 0.0
    np.testing.assert_array_equal(rows[0], START)


def test_eef_rows_become_the_joints_that_they_were_made_of() -> None:
    rows = path(20)
    made = commanded(ActionChunk(SPACES.eef_of(rows), space="eef"))
    assert made.solved is not None
    assert made.solved.reached.all()
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
    assert made.solved is not None
    assert made.solved.reached.all()
    np.testing.assert_allclose(made.rows, expected, atol=1e-5)


def test_velocity_limits_hold_from_one_control_period_to_the_next_whatever_the_chunks_rate() -> None:
    there = START.copy()
    there[0] += 1.0
    eef = SPACES.eef_of(np.stack([START, there]))
    slow = commanded(ActionChunk(eef, space="eef", rate=2.0))
    fast = commanded(ActionChunk(eef, space="eef"))
    assert len(slow.rows) == 30
    assert slow.source.tolist() == [0] * 15 + [1] * 15
    assert slow.rows[15, 0] - slow.rows[0, 0] == pytest.approx(1.0, abs=1e-3)
    for made in (slow, fast):
        assert np.all(np.abs(np.diff(made.rows, axis=0)) <= ROBOT.velocity / 30 + 1e-9)


def test_a_pose_that_cannot_be_reached_is_reported_arm_by_arm() -> None:
    eef = SPACES.eef_of(path(4))
    eef[2:, 8] += 2.0
    result = commanded(ActionChunk(eef, space="eef")).solved
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
        (np.zeros((2, 16)), "eef", "no orientation for left_arm in row 0: qw, qx, qy, qz = 0, 0, 0, 0; allowed"),
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
        Spaces(ROBOT, CompiledKinematics(ROBOT), 0.0)


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


@settings(max_examples=20, deadline=None)
@given(modes, st.sampled_from(["base", "tool"]), st.integers(1, 6), st.floats(-0.02, 0.02))
def test_relative_poses_come_back_to_the_absolute_ones_they_were_made_of(
    mode: str, frame: str, count: int, step: float
) -> None:
    rows = path(count, step)
    offsets = relative_poses(SPACES.eef_of(rows), SPACES.eef_of(START), mode, frame)
    made = commanded(ActionChunk(offsets, space="eef", mode=mode, frame=frame))  # type: ignore[arg-type]
    assert made.solved is not None
    assert made.solved.reached.all()
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


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 6), st.sampled_from([7.5, 10.0, 30.0, 50.0]))
def test_poses_of_another_rate_stay_on_the_straight_way_between_rows(count: int, rate: float) -> None:
    ends = SPACES.eef_of(path(count)).astype(np.float64)
    made = commanded(ActionChunk(ends.astype(np.float32), space="eef", rate=rate))
    assert made.solved is not None
    assert made.solved.reached.all()
    assert len(made.rows) == len(made.source) == int(count * 30.0 / rate + 1e-9)
    between = SPACES.eef_of(made.rows)[:, :3] if len(made.rows) else np.empty((0, 3))
    meant = np.minimum(np.arange(len(made.rows)) * rate / 30.0, count - 1)
    for axis in range(3):
        straight = np.interp(meant, np.arange(count), ends[:, axis])
        np.testing.assert_allclose(between[:, axis], straight, atol=1e-3)


def test_a_delta_is_summed_at_the_policys_rate_before_it_is_resampled() -> None:
    steps = np.zeros((3, 14), np.float32)
    steps[:, 0] = 0.1
    made = commanded(ActionChunk(steps, mode="delta", rate=15.0))
    np.testing.assert_allclose(made.rows[:, 0] - START[0], [0.1, 0.15, 0.2, 0.25, 0.3, 0.3], atol=1e-6)
    assert made.source.tolist() == [0, 0, 1, 1, 2, 2]


# Grippers that know two values, joints without end

SWITCHED = replace(
    ROBOT,
    groups=tuple(
        replace(group, gripper=replace(group.gripper, binary=True, threshold=0.05)) for group in ROBOT.groups
    ),
)
ENDLESS_DIM = 5
LOWER, UPPER = ROBOT.lower.copy(), ROBOT.upper.copy()
LOWER[ENDLESS_DIM], UPPER[ENDLESS_DIM] = -np.inf, np.inf
ENDLESS = replace(ROBOT, lower=LOWER, upper=UPPER)


@settings(max_examples=20, deadline=None)
@given(st.lists(st.sampled_from([0.0, 0.1]), min_size=1, max_size=5), st.sampled_from(["joint", "eef"]))
def test_binary_grippers_stay_binary_at_every_rate(values: list[float], space: str) -> None:
    spaces = Spaces(SWITCHED, CompiledKinematics(SWITCHED), 30.0)
    rows = path(len(values), 0.0)
    rows[:, 6] = values
    given_ = rows if space == "joint" else spaces.eef_of(rows)
    made = spaces.to_command(ActionChunk(given_, space=space, rate=12.0), seen())  # type: ignore[arg-type]
    np.testing.assert_array_equal(made.rows[:, 6].astype(np.float32), rows[made.source, 6])


@given(st.floats(-20, 20), st.integers(-3, 3), st.integers(1, 8))
def test_a_joint_without_end_goes_on_from_where_it_was_seen(at: float, turns: int, count: int) -> None:
    spaces = Spaces(ENDLESS, CompiledKinematics(ENDLESS), 30.0)
    start = START.copy()
    start[ENDLESS_DIM] = at
    way = start[ENDLESS_DIM] + 0.3 * np.arange(count, dtype=np.float32)
    rows = path(count, 0.0)
    rows[:, ENDLESS_DIM] = (way + np.pi) % (2 * np.pi) - np.pi + 2 * np.pi * turns
    made = spaces.to_command(ActionChunk(rows, rate=15.0), seen(start))
    np.testing.assert_allclose(made.rows[::2, ENDLESS_DIM], way, atol=1e-4)
    assert np.all(np.abs(np.diff(made.rows[:, ENDLESS_DIM])) <= 0.16)
