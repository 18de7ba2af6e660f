"""Every orientation format against scipy's Rotation, which knows nothing of ours."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from runtime.spaces.orientations import (
    EulerAngles,
    Orientation,
    QuaternionOrientation,
    RotationVector,
    SixD,
    continuous_signs,
)
from tests.examples import some

ORDERS = ["".join(o) for o in product("xyz", repeat=3) if o[0] != o[1] and o[1] != o[2]]
ORDERS += [order.upper() for order in ORDERS]
QUARTER = np.pi / 2
EXACT = 1e-9

codecs = st.one_of(
    st.sampled_from([True, False]).map(QuaternionOrientation),
    st.builds(EulerAngles, st.sampled_from(ORDERS), st.booleans()),
    st.booleans().map(RotationVector),
    st.booleans().map(SixD),
)
# Ordinary angles, and those at which formats break: none, tiny, a quarter, half a turn, a hair beside them.
awkward = st.sampled_from([0.0, QUARTER, -QUARTER, np.pi, -np.pi])
angles = st.one_of(
    st.floats(-np.pi, np.pi),
    awkward,
    st.builds(lambda at, beside: at + beside, awkward, st.floats(-1e-6, 1e-6)),
    st.floats(-1e-12, 1e-12),
)
turns = st.builds(
    lambda order, three: Rotation.from_euler(order, three),
    st.sampled_from(ORDERS),
    st.lists(angles, min_size=3, max_size=3),
)
vectors = st.builds(
    lambda axis, angle: Rotation.from_rotvec(np.array(axis) / max(1e-3, np.linalg.norm(axis)) * angle),
    st.lists(st.floats(-1, 1), min_size=3, max_size=3),
    angles,
)
rotations = st.lists(st.one_of(turns, vectors), min_size=1, max_size=6)


def wxyz(rotations_: list[Rotation]) -> np.ndarray:
    """[T, 1, 4], scalar first."""
    return np.array([r.as_quat(scalar_first=True) for r in rotations_])[:, None]


def apart(first: np.ndarray, second: np.ndarray) -> float:
    """The largest angle between quaternions [..., 4], by scipy [rad]."""
    one = Rotation.from_quat(first.reshape(-1, 4), scalar_first=True)
    other = Rotation.from_quat(second.reshape(-1, 4), scalar_first=True)
    return float((one.inv() * other).magnitude().max())


@settings(max_examples=some(400))
@given(codecs, rotations)
def test_what_is_written_down_comes_back_exactly(codec: Orientation, given_: list[Rotation]) -> None:
    quaternions = wxyz(given_)
    numbers = codec.encode(quaternions)
    assert numbers.shape == (len(given_), 1, len(codec.fields))
    back, determined = codec.decode(numbers)
    assert determined.all()
    np.testing.assert_allclose(np.linalg.norm(back, axis=-1), 1.0, atol=1e-12)
    assert apart(quaternions, back) < EXACT


@settings(max_examples=some(300))
@given(st.sampled_from(ORDERS), st.booleans(), st.lists(angles, min_size=3, max_size=3))
def test_euler_angles_mean_what_scipy_says(order: str, degrees: bool, three: list[float]) -> None:
    given_ = np.degrees(three) if degrees else np.array(three)
    back, _ = EulerAngles(order, degrees).decode(given_[None, None])
    expected = Rotation.from_euler(order, given_, degrees=degrees).as_quat(scalar_first=True)
    assert apart(back, expected) < EXACT


@pytest.mark.filterwarnings("ignore:Gimbal lock")
@settings(max_examples=some(300))
@given(st.sampled_from(ORDERS), st.one_of(turns, vectors))
def test_single_euler_angles_are_in_the_range_of_scipys(order: str, turn: Rotation) -> None:
    expected = turn.as_euler(order)
    found = EulerAngles(order).encode(wxyz([turn]))[0, 0]
    assert apart(Rotation.from_euler(order, found).as_quat(scalar_first=True), wxyz([turn])) < EXACT
    assert (np.abs(found) <= np.pi + 1e-12).all()
    proper = order[0] == order[2]
    low, high = (0.0, np.pi) if proper else (-QUARTER, QUARTER)
    assert low - 1e-12 <= found[1] <= high + 1e-12
    if min(found[1] - low, high - found[1]) > 1e-3:  # elsewhere one angle is free, or nearly so
        np.testing.assert_allclose(np.exp(1j * found), np.exp(1j * expected), atol=1e-7)


@settings(max_examples=some(200))
@given(st.one_of(turns, vectors), st.booleans())
def test_rotation_vectors_are_scipys(turn: Rotation, degrees: bool) -> None:
    vector = turn.as_rotvec(degrees=degrees)
    back, _ = RotationVector(degrees).decode(vector[None, None])
    assert apart(back, turn.as_quat(scalar_first=True)) < EXACT
    found = RotationVector(degrees).encode(wxyz([turn]))[0, 0]
    length = np.linalg.norm(found)
    assert length <= (180.0 if degrees else np.pi) + 1e-9
    if turn.magnitude() < np.pi - 1e-6:
        np.testing.assert_allclose(found, vector, atol=1e-7 if degrees else 1e-9)


@given(st.floats(1e-300, 1e-9), st.integers(0, 2))
def test_tiny_angles_keep_all_their_digits(angle: float, axis: int) -> None:
    vector = np.zeros((1, 1, 3))
    vector[..., axis] = angle
    back, _ = RotationVector().decode(vector)
    np.testing.assert_allclose(RotationVector().encode(back), vector, rtol=1e-12, atol=0)


@settings(max_examples=some(200))
@given(st.one_of(turns, vectors))
def test_six_numbers_are_columns_or_rows_of_the_matrix(turn: Rotation) -> None:
    matrix = turn.as_matrix()
    columns = SixD(True).encode(wxyz([turn]))[0, 0]
    rows = SixD(False).encode(wxyz([turn]))[0, 0]
    np.testing.assert_allclose(columns, np.concatenate([matrix[:, 0], matrix[:, 1]]), atol=1e-12)
    np.testing.assert_allclose(rows, np.concatenate([matrix[0], matrix[1]]), atol=1e-12)


def test_six_numbers_that_a_network_predicted_are_straightened_as_by_gram_and_schmidt() -> None:
    turn = Rotation.from_euler("xyz", [0.3, -0.4, 1.1])
    first, second = turn.as_matrix()[:, 0], turn.as_matrix()[:, 1]
    sloppy = np.concatenate([1.4 * first, 0.7 * second + 0.3 * first])
    back, determined = SixD(True).decode(sloppy[None, None])
    assert determined.all()
    assert apart(back, turn.as_quat(scalar_first=True)) < EXACT


@pytest.mark.parametrize(
    ("codec", "numbers"),
    [
        (QuaternionOrientation(True), [0.0, 0.0, 0.0, 0.0]),
        (QuaternionOrientation(False), [1e-4, 0.0, 0.0, 0.0]),
        (SixD(True), [0.0, 0.0, 0.0, 0.0, 1.0, 0.0]),
        (SixD(True), [1.0, 0.0, 0.0, -2.0, 0.0, 0.0]),
        (SixD(False), [1.0, 2.0, 3.0, 2.0, 4.0, 6.0]),
    ],
)
def test_numbers_that_determine_no_orientation_are_pointed_out(
    codec: Orientation, numbers: list[float]
) -> None:
    fine = codec.encode(np.array([[[1.0, 0.0, 0.0, 0.0]]]))[0, 0]
    back, determined = codec.decode(np.array([[fine, numbers]]))
    assert determined.tolist() == [[True, False]]
    np.testing.assert_allclose(back[0, 1], [1, 0, 0, 0])


@pytest.mark.parametrize("scalar_first", [True, False])
def test_the_scalar_is_where_it_is_said_to_be(scalar_first: bool) -> None:
    found = QuaternionOrientation(scalar_first).encode(np.array([[[0.5, 0.1, 0.7, -0.5]]]))
    expected = [0.5, 0.1, 0.7, -0.5] if scalar_first else [0.1, 0.7, -0.5, 0.5]
    np.testing.assert_array_equal(found[0, 0], expected)


# Rows of a chunk


def path(count: int, seed: int, span: float = 4.0) -> np.ndarray:
    """Quaternions [T, 1, 4] of a smooth motion that turns far, signs at random."""
    chance = np.random.default_rng(seed)
    ends = Rotation.from_rotvec(chance.uniform(-span, span, (4, 3)))
    way = Slerp([0, 1, 2, 3], ends)(np.linspace(0, 3, count))
    return (way.as_quat(scalar_first=True) * chance.choice([-1.0, 1.0], (count, 1)))[:, None]


@settings(max_examples=some(60))
@given(st.booleans(), st.integers(0, 1000))
def test_quaternions_keep_their_sign_from_row_to_row(scalar_first: bool, seed: int) -> None:
    way = path(200, seed)
    rows = QuaternionOrientation(scalar_first).encode(way)
    assert ((rows[1:] * rows[:-1]).sum(axis=-1) > 0.9).all()
    later = QuaternionOrientation(scalar_first).encode(way[50:], rows[49])
    np.testing.assert_array_equal(later, rows[50:])


@pytest.mark.exhaustive
@settings(max_examples=some(60))
@given(st.booleans(), st.integers(0, 1000))
def test_rotation_vectors_do_not_jump_where_half_a_turn_is_passed(degrees: bool, seed: int) -> None:
    way = path(1500, seed)
    rows = RotationVector(degrees).encode(way)
    unit = np.pi / 180 if degrees else 1.0
    length = np.linalg.norm(rows[:, 0], axis=-1) * unit
    steps = np.linalg.norm(np.diff(rows[:, 0], axis=0), axis=-1) * unit
    # Beyond a whole turn an axis may swing about: no continuous vector exists there.
    far = np.abs(np.remainder(length + np.pi, 2 * np.pi) - np.pi) > 0.7
    beyond = length < 2 * np.pi - 0.7
    assert (steps[(far & beyond)[1:]] < 0.3).all()
    np.testing.assert_array_less(steps, np.pi + 0.3)
    continued = RotationVector(degrees).encode(way[700:], rows[699])
    np.testing.assert_allclose(continued, rows[700:], atol=1e-9)


def test_a_vector_turns_on_beyond_half_a_turn() -> None:
    angles_ = np.linspace(2.8, 3.6, 9)
    way = np.stack([np.cos(angles_ / 2), 0 * angles_, np.sin(angles_ / 2), 0 * angles_], axis=-1)[:, None]
    rows = RotationVector().encode(way)
    np.testing.assert_allclose(rows[:, 0, 1], angles_, atol=1e-12)


@pytest.mark.exhaustive
@settings(max_examples=some(60))
@given(st.sampled_from(ORDERS), st.booleans(), st.integers(0, 1000))
def test_euler_angles_do_not_jump_by_turns_where_they_are_continuous(
    order: str, degrees: bool, seed: int
) -> None:
    way = path(1500, seed)
    codec = EulerAngles(order, degrees)
    rows = codec.encode(way)
    unit = np.pi / 180 if degrees else 1.0
    middle = rows[:, 0, 1] * unit
    proper = order[0] == order[2]
    room = np.abs(np.sin(middle)) if proper else np.abs(np.cos(middle))
    steps = np.abs(np.diff(rows[:, 0], axis=0)).max(axis=-1) * unit
    assert (steps[(room[1:] > 0.3) & (room[:-1] > 0.3)] < 0.3).all()
    assert apart(codec.decode(rows)[0], way) < EXACT


@pytest.mark.parametrize("order", ORDERS)
def test_a_hand_that_passes_the_gimbal_lock_straight_keeps_its_other_angles(order: str) -> None:
    middle = np.linspace(-0.4, 0.4, 9) + (0.0 if order[0] == order[2] else QUARTER)
    given_ = np.stack([0 * middle + 0.3, middle, 0 * middle - 0.2], axis=-1)
    way = wxyz(list(Rotation.from_euler(order, given_)))
    rows = EulerAngles(order).encode(way, given_[:1])
    np.testing.assert_allclose(rows[:, 0], given_, atol=1e-7)


def test_signs_follow_the_row_before() -> None:
    rows = np.array([[[1.0, 0, 0, 0]], [[-0.9, 0.1, 0, 0]], [[-0.8, 0.2, 0, 0]], [[0.7, 0, 0, 0]]])
    assert continuous_signs(rows)[:, 0, 0].tolist() == [1, -1, -1, 1]
