from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from runtime.resampling import resample


def ramp(count: int) -> np.ndarray:
    return np.arange(count, dtype=np.float64)[:, None]


def test_numbers_are_linear_between_rows_and_the_last_row_is_held() -> None:
    made, source = resample(ramp(4), 30, 60)
    assert made[:, 0].tolist() == [0, 0.5, 1, 1.5, 2, 2.5, 3, 3]
    assert source.tolist() == [0, 0, 1, 1, 2, 2, 3, 3]


def test_held_columns_keep_the_value_of_their_row() -> None:
    rows = np.array([[0.0, 0.0], [1.0, 1.0]])
    assert resample(rows, 30, 90, held=[1])[0][:, 1].tolist() == [0, 0, 0, 1, 1, 1]


def test_rows_of_the_wanted_rate_are_the_rows_themselves() -> None:
    rows = ramp(3)
    assert resample(rows, 30, 30)[0] is rows


@given(st.integers(1, 60), st.floats(1, 200), st.floats(1, 200))
def test_resampled_rows_last_as_long_and_name_a_row_each(count: int, rate: float, wanted: float) -> None:
    made, source = resample(ramp(count), rate, wanted)
    assert abs(len(made) / wanted - count / rate) < 1 / wanted + 1e-9
    assert source.min(initial=0) >= 0
    assert source.max(initial=0) < count
    assert np.all(np.abs(made[:, 0] - source) <= 1 + 1e-6)


@given(
    st.lists(st.lists(st.floats(-1, 1), min_size=4, max_size=4), min_size=2, max_size=5), st.floats(2, 100)
)
def test_quaternions_turn_on_the_shorter_arc_and_stay_unit(rows: list[list[float]], wanted: float) -> None:
    quaternions = np.array(rows)
    quaternions[np.linalg.norm(quaternions, axis=1) < 0.01] = [1, 0, 0, 0]
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    made, source = resample(np.hstack([ramp(len(rows)), quaternions]), 10.0, wanted, quaternions=[1])
    np.testing.assert_allclose(np.linalg.norm(made[:, 1:], axis=1), 1.0, atol=1e-12)
    times = np.minimum(np.arange(len(made)) * 10.0 / wanted, len(rows) - 1)
    turning = Slerp(np.arange(len(rows)), Rotation.from_quat(quaternions, scalar_first=True))
    opposed = (
        np.abs((quaternions[1:] * quaternions[:-1]).sum(axis=1)) < 1e-4
    )  # half a turn: either way is right
    clear = ~np.append(opposed, False)[source]
    apart = (Rotation.from_quat(made[:, 1:], scalar_first=True) * turning(times).inv()).magnitude()
    assert np.all(apart[clear] < 1e-5)
