from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robots import load
from runtime.errors import PolicyError, SetupError
from runtime.kinematics.numeric import NumericKinematics
from runtime.spaces import Spaces, canonical
from runtime.types import ActionChunk

ROBOT = load("agilex_piper")
SPACES = Spaces(ROBOT, NumericKinematics(ROBOT), 30.0)
START = np.array(
    [0.1, 1.2, -1.0, 0.3, 0.4, 0.2, 0.03, -0.2, 0.9, -0.8, 0.1, -0.4, 0.5, 0.08], dtype=np.float32
)


def path(rows: int, step: float = 0.01) -> np.ndarray:
    moving = np.ones(14) * step
    moving[[6, 13]] = 0.001
    return (START + np.arange(rows)[:, None] * moving).astype(np.float32)


def test_joint_rows_pass_as_they_are_in_float64() -> None:
    rows = path(5)
    commands, result = SPACES.to_command(ActionChunk(rows), START)
    assert result is None
    assert commands.dtype == np.float64
    np.testing.assert_array_equal(commands.astype(np.float32), rows)
    commands[0] = 0.0
    np.testing.assert_array_equal(rows[0], START)


def test_eef_rows_become_the_joints_that_they_were_made_of() -> None:
    rows = path(20)
    commands, result = SPACES.to_command(ActionChunk(SPACES.eef_of(rows), space="eef"), START)
    assert result is not None
    assert result.reached.all()
    assert commands.dtype == np.float64
    np.testing.assert_allclose(commands, rows, atol=1e-4)


def test_grippers_are_taken_from_the_chunk_also_outside_their_range() -> None:
    eef = SPACES.eef_of(path(3))
    eef[:, 7] = [0.0, -0.003, 0.103]
    eef[:, 15] = 0.05
    commands, _ = SPACES.to_command(ActionChunk(eef, space="eef"), START)
    np.testing.assert_array_equal(commands[:, 6], eef[:, 7].astype(np.float64))
    np.testing.assert_array_equal(commands[:, 13], eef[:, 15].astype(np.float64))


def test_quaternions_that_are_not_quite_unit_or_of_the_other_sign_give_the_same_joints() -> None:
    eef = SPACES.eef_of(path(6))
    sloppy = eef.copy()
    sloppy[:, 3:7] *= 1.03
    sloppy[::2, 11:15] *= -1.0
    expected, _ = SPACES.to_command(ActionChunk(eef, space="eef"), START)
    commands, result = SPACES.to_command(ActionChunk(sloppy, space="eef"), START)
    assert result is not None
    assert result.reached.all()
    np.testing.assert_allclose(commands, expected, atol=1e-5)


def test_the_chunks_own_rate_bounds_how_far_joints_move_between_rows() -> None:
    there = START.copy()
    there[0] += 1.0
    eef = SPACES.eef_of(np.stack([START, there]))
    slow, missed = SPACES.to_command(ActionChunk(eef, space="eef", rate=2.0), START)
    fast, _ = SPACES.to_command(ActionChunk(eef, space="eef"), START)
    assert missed is not None
    assert missed.reached[1, 0]
    assert slow[1, 0] - slow[0, 0] == pytest.approx(1.0, abs=1e-3)
    assert np.all(np.abs(np.diff(fast, axis=0)[0]) <= ROBOT.velocity / 30 + 1e-9)


def test_a_pose_that_cannot_be_reached_is_reported_arm_by_arm() -> None:
    eef = SPACES.eef_of(path(4))
    eef[2:, 8] += 2.0
    _, result = SPACES.to_command(ActionChunk(eef, space="eef"), START)
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
        (np.zeros((2, 16)), "eef", r"quaternion \[0\.0, 0\.0, 0\.0, 0\.0\], arm 0, row 0"),
    ],
)
def test_an_answer_of_the_wrong_shape_or_without_direction_is_named(
    actions: np.ndarray, space: str, said: str
) -> None:
    with pytest.raises(PolicyError, match=said):
        SPACES.to_command(ActionChunk(actions.astype(np.float32), space=space), START)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("space", "column", "name"), [("joint", 9, "right_arm.joint2"), ("eef", 4, "left_arm.qx")]
)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_number_that_is_not_finite_is_named(space: str, column: int, name: str, value: float) -> None:
    rows = path(4) if space == "joint" else SPACES.eef_of(path(4))
    rows[2, column] = value
    with pytest.raises(PolicyError, match=f"answered with {value} for {name} in row 2"):
        SPACES.to_command(ActionChunk(rows, space=space), START)  # type: ignore[arg-type]


def test_a_rate_that_is_no_rate_is_refused() -> None:
    with pytest.raises(SetupError, match=r"control_rate = 0\.0 Hz; allowed: above zero"):
        Spaces(ROBOT, NumericKinematics(ROBOT), 0.0)


def test_eef_of_one_vector_is_pose_and_gripper_of_each_arm() -> None:
    vector = SPACES.eef_of(START)
    poses = NumericKinematics(ROBOT).forward(START.astype(np.float64))
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


@settings(max_examples=50)
@given(st.lists(st.lists(st.floats(-1, 1), min_size=4, max_size=4), min_size=1, max_size=8))
def test_canonical_vectors_are_unit_continuous_and_start_with_w_not_negative(rows: list[list[float]]) -> None:
    quaternions = np.array(rows)[:, None]
    quaternions[np.linalg.norm(quaternions, axis=-1) < 0.01] = [1, 0, 0, 0]
    vectors = np.concatenate([np.zeros((len(rows), 1, 3)), quaternions, np.zeros((len(rows), 1, 1))], axis=-1)
    result = canonical(vectors)[..., 3:7]
    np.testing.assert_allclose(np.linalg.norm(result, axis=-1), 1.0, atol=1e-12)
    assert result[0, 0, 0] >= 0
    assert ((result[1:] * result[:-1]).sum(axis=-1) >= 0).all()
    lengths = np.linalg.norm(quaternions, axis=-1)
    np.testing.assert_allclose(np.abs((result * quaternions).sum(axis=-1)), lengths, atol=1e-12)
