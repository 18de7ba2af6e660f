from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from runtime.motion.resampling import resample, resampled_length
from runtime.motion.timeline import DimensionKinds, Timeline
from runtime.strategies.base import ArrivedChunk
from runtime.strategies.ensemble import EnsembleMerge


def ramp(count: int) -> np.ndarray:
    return np.arange(count, dtype=np.float64)[:, None]


def test_numbers_are_linear_between_rows_and_end_with_the_last_one() -> None:
    made, source = resample(ramp(4), 30, 60)
    assert made[:, 0].tolist() == [0, 0.5, 1, 1.5, 2, 2.5, 3]
    assert source.tolist() == [0, 0, 1, 1, 2, 2, 3]


@pytest.mark.parametrize(("rate", "wanted"), [(60, 30), (10, 30), (1000, 1)])
def test_a_single_row_is_a_single_row_at_any_rate(rate: float, wanted: float) -> None:
    made, source = resample(ramp(1), rate, wanted)
    assert (made.tolist(), source.tolist()) == ([[0.0]], [0])


def test_held_columns_keep_the_value_of_their_row() -> None:
    rows = np.array([[0.0, 0.0], [1.0, 1.0]])
    assert resample(rows, 30, 90, held=[1])[0][:, 1].tolist() == [0, 0, 0, 1]


def test_rows_of_the_wanted_rate_are_the_rows_themselves() -> None:
    rows = ramp(3)
    assert resample(rows, 30, 30)[0] is rows


@given(st.integers(1, 60), st.floats(1, 200), st.floats(1, 200))
def test_every_row_is_of_a_time_that_the_given_rows_cover_and_linear_between_them(
    count: int, rate: float, wanted: float
) -> None:
    given_rows = np.sin(ramp(count))
    made, source = resample(given_rows, rate, wanted)
    times, last = np.arange(len(made)) / wanted, (count - 1) / rate
    assert 1 <= len(made) == resampled_length(count, rate, wanted)
    assert times[-1] <= last + 1e-9 < times[-1] + 1 / wanted + 2e-9
    np.testing.assert_allclose(
        made[:, 0], np.interp(times, np.arange(count) / rate, given_rows[:, 0]), atol=1e-6
    )
    np.testing.assert_array_equal(source, np.floor(times * rate + 1e-9))


@given(
    st.floats(2, 120),
    st.sampled_from([10.0, 25.0, 30.0, 50.0]),
    st.lists(st.tuples(st.integers(1, 40), st.integers(0, 12)), min_size=1, max_size=8),
)
def test_chunks_that_agree_average_to_what_they_agree_on(
    rate: float, control: float, chunks: list[tuple[int, int]]
) -> None:
    merge, timeline, step = EnsembleMerge(None, 0.01, 8, DimensionKinds()), Timeline(1), 0
    for number, (count, later) in enumerate(chunks, 1):
        step += later
        times = step / control + np.arange(count) / rate
        rows, _ = resample(0.3 * times[:, None] - 0.1, rate, control)
        merge(timeline, ArrivedChunk(number, step, rows), step)
        for planned in range(step, step + timeline.remaining(step)):
            assert abs(timeline.at(planned).action[0] - (0.3 * planned / control - 0.1)) < 1e-9  # type: ignore[union-attr]


@given(
    st.lists(st.lists(st.floats(-1, 1), min_size=4, max_size=4), min_size=2, max_size=5), st.floats(2, 100)
)
def test_quaternions_turn_on_the_shorter_arc_and_stay_unit(rows: list[list[float]], wanted: float) -> None:
    quaternions = np.array(rows)
    quaternions[np.linalg.norm(quaternions, axis=1) < 0.01] = [1, 0, 0, 0]
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    made, source = resample(np.hstack([ramp(len(rows)), quaternions]), 10.0, wanted, quaternions=[1])
    np.testing.assert_allclose(np.linalg.norm(made[:, 1:], axis=1), 1.0, atol=1e-12)
    times = np.minimum(np.arange(len(made)) * 10.0 / wanted, len(rows) - 1.0)
    turning = Slerp(np.arange(len(rows)), Rotation.from_quat(quaternions, scalar_first=True))
    opposed = (
        np.abs((quaternions[1:] * quaternions[:-1]).sum(axis=1)) < 1e-4
    )  # half a turn: either way is right
    clear = ~np.append(opposed, False)[source]
    apart = (Rotation.from_quat(made[:, 1:], scalar_first=True) * turning(times).inv()).magnitude()
    assert np.all(apart[clear] < 1e-5)
