from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from robots import rotations

angles = st.floats(-math.pi, math.pi)
quaternions = arrays(np.float64, 4, elements=st.floats(-1, 1)).filter(lambda q: np.linalg.norm(q) > 1e-3)


@given(angles, angles, angles)
def test_rpy_turns_about_fixed_axes_in_the_order_x_y_z(roll: float, pitch: float, yaw: float) -> None:
    expected = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix()
    np.testing.assert_allclose(rotations.matrix_of_rpy(roll, pitch, yaw), expected, atol=1e-12)


@given(quaternions)
def test_a_quaternion_survives_the_way_over_a_matrix_with_w_not_negative(given_: np.ndarray) -> None:
    unit = given_ / np.linalg.norm(given_)
    back = rotations.quaternion_of_matrix(rotations.matrix_of_quaternion(unit))
    assert back[0] >= 0
    assert abs(np.linalg.norm(back) - 1) < 1e-12
    assert abs(abs(unit @ back) - 1) < 1e-12


@given(arrays(np.float64, 3, elements=st.floats(-1.8, 1.8)))
def test_a_rotation_vector_is_recovered_from_its_matrix(vector: np.ndarray) -> None:
    found = rotations.rotation_vector(Rotation.from_rotvec(vector).as_matrix())
    np.testing.assert_allclose(found, vector, atol=1e-9)


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, -1], [0.6, 0, 0.8]])
def test_half_a_turn_has_the_length_pi(axis: list[float]) -> None:
    vector = rotations.rotation_vector(Rotation.from_rotvec(np.array(axis) * math.pi).as_matrix())
    assert np.linalg.norm(vector) == pytest.approx(math.pi, abs=1e-9)
    assert abs(vector @ np.array(axis)) == pytest.approx(math.pi, abs=1e-9)


def test_batches_give_what_single_calls_give() -> None:
    matrices = Rotation.random(12, random_state=3).as_matrix().reshape(3, 4, 3, 3)
    together = rotations.quaternion_of_matrix(matrices)
    vectors = rotations.rotation_vector(matrices)
    for index in np.ndindex(3, 4):
        np.testing.assert_array_equal(together[index], rotations.quaternion_of_matrix(matrices[index]))
        np.testing.assert_allclose(vectors[index], rotations.rotation_vector(matrices[index]), atol=1e-15)


@given(quaternions, quaternions)
def test_a_product_of_quaternions_turns_by_the_right_one_first(left: np.ndarray, right: np.ndarray) -> None:
    left, right = left / np.linalg.norm(left), right / np.linalg.norm(right)
    made = rotations.matrix_of_quaternion(rotations.quaternion_product(left, right))
    expected = rotations.matrix_of_quaternion(left) @ rotations.matrix_of_quaternion(right)
    np.testing.assert_allclose(made, expected, atol=1e-12)


@given(quaternions, quaternions, st.floats(0, 1))
def test_slerp_goes_its_part_of_the_shorter_way(start: np.ndarray, end: np.ndarray, part: float) -> None:
    start, end = start / np.linalg.norm(start), end / np.linalg.norm(end)
    between = rotations.slerp(start, end, np.array(part))
    assert abs(np.linalg.norm(between) - 1) < 1e-12
    first, last, found = (Rotation.from_quat(q, scalar_first=True) for q in (start, end, between))
    whole = (last * first.inv()).magnitude()
    assert (found * first.inv()).magnitude() == pytest.approx(part * whole, abs=1e-6)
    assert (last * found.inv()).magnitude() == pytest.approx((1 - part) * whole, abs=1e-6)
