import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from runtime.timeline import Timeline, overlap_blend, resample


def ramp(start, count):
    return np.arange(start, start + count, dtype=float)[:, None]


def test_an_empty_timeline_plans_nothing():
    timeline = Timeline(2)
    assert timeline.at(0) is None
    assert timeline.remaining(7) == 0


def test_a_plan_is_found_by_its_absolute_step():
    timeline = Timeline(1)
    timeline.replace(10, ramp(0, 3), [((5, 1.0),)] * 3)
    assert timeline.at(9) is None
    assert timeline.at(11).action[0] == 1
    assert timeline.at(11).makers == ((5, 1.0),)
    assert timeline.at(13) is None
    assert [timeline.remaining(step) for step in (0, 10, 12, 13, 99)] == [3, 3, 1, 0, 0]


def test_the_blend_goes_from_all_old_to_all_new():
    blended, weights = overlap_blend(np.zeros((10, 1)), np.ones((20, 1)), 5)
    assert blended[:6, 0].tolist() == [0, 0.25, 0.5, 0.75, 1, 1]
    assert weights.tolist() == [1, 0.75, 0.5, 0.25, 0]
    assert len(blended) == 20


@pytest.mark.parametrize(("old", "window"), [(1, None), (0, None), (10, 1)])
def test_an_overlap_of_one_step_takes_the_new_action(old, window):
    blended, _ = overlap_blend(np.zeros((old, 1)), np.ones((4, 1)), window)
    assert (blended == 1).all()


def test_a_binary_gripper_switches_and_is_never_blended():
    blended, _ = overlap_blend(np.zeros((10, 2)), np.ones((10, 2)), None, switched=[1])
    assert set(blended[:, 1]) == {1.0}
    assert blended[4, 0] not in (0.0, 1.0)


@given(arrays(np.float32, (12, 3), elements=st.floats(-3, 3, width=32)), st.integers(1, 12))
def test_equal_plans_blend_to_the_same_numbers_exactly(rows, window):
    wide = rows.astype(np.float64)
    blended, _ = overlap_blend(wide, wide.copy(), window)
    assert (blended.astype(np.float32) == rows).all()


def test_resampling_to_a_faster_rate_keeps_the_original_rows_where_they_fall():
    resampled, source = resample(ramp(0, 4), 30, 60)
    assert resampled[:, 0].tolist() == [0, 0.5, 1, 1.5, 2, 2.5, 3, 3]
    assert source.tolist() == [0, 0, 1, 1, 2, 2, 3, 3]


def test_resampling_holds_what_switches():
    rows = np.array([[0.0, 0.0], [1.0, 1.0]])
    resampled, _ = resample(rows, 30, 90, switched=[1])
    assert resampled[:, 1].tolist() == [0, 0, 0, 1, 1, 1]


def test_resampling_to_the_same_rate_changes_nothing():
    rows = ramp(3, 5)
    assert resample(rows, 30, 30)[0] is rows


@given(st.integers(1, 60), st.sampled_from([10, 15, 30, 50]), st.sampled_from([20, 30, 100, 200]))
def test_a_resampled_chunk_lasts_as_long_as_the_chunk(count, rate, control_rate):
    resampled, source = resample(ramp(0, count), rate, control_rate)
    assert abs(len(resampled) / control_rate - count / rate) < 1 / control_rate + 1e-9
    assert (np.diff(source) >= 0).all()
    assert resampled.max(initial=0) <= count - 1
