import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from runtime.motion.timeline import (
    DimensionKinds,
    Fade,
    PlacedChunk,
    Timeline,
    difference,
    fade_weights,
    mix_contributions,
    overlap_blend,
    single_contribution,
    unwrap_onto,
)

SHAPES = ("linear", "cosine", "exponential")


def ramp(start, count):
    return np.arange(start, start + count, dtype=float)[:, None]


def test_an_empty_timeline_plans_nothing():
    timeline = Timeline(2)
    assert timeline.at(0) is None
    assert timeline.remaining(7) == 0
    assert timeline.executed_rows(3)[0].shape == (0, 2)


def test_a_plan_is_found_by_its_absolute_step():
    timeline = Timeline(1)
    timeline.replace(10, ramp(0, 3), single_contribution(5, 3))
    assert timeline.at(9) is None
    assert timeline.at(11).action[0] == 1
    assert timeline.at(11).contributions == ((5, 1.0),)
    assert timeline.at(13) is None
    assert [timeline.remaining(step) for step in (0, 10, 12, 13, 99)] == [3, 3, 1, 0, 0]


def test_a_fade_goes_on_over_whatever_is_planned_meanwhile():
    timeline = Timeline(1)
    timeline.begin_fade(
        Fade(0, np.zeros((5, 1)), tuple(single_contribution(0, 5)), fade_weights(5), DimensionKinds())
    )
    timeline.replace(0, np.ones((9, 1)), single_contribution(1, 9))
    assert timeline.executed_rows(0)[0][:, 0].tolist() == [0, 0.25, 0.5, 0.75, 1, 1, 1, 1, 1]
    timeline.replace(2, np.full((9, 1), 2.0), single_contribution(2, 9))
    assert timeline.at(2).action[0] == 1.0
    assert timeline.at(3).contributions == ((0, 0.25), (2, 0.75))
    assert timeline.executed_rows(3)[0][:2, 0].tolist() == [1.5, 2.0]


def test_a_fade_that_is_over_is_forgotten_and_so_is_everything_when_cleared():
    timeline = Timeline(1)
    timeline.begin_fade(
        Fade(0, np.zeros((5, 1)), tuple(single_contribution(0, 5)), fade_weights(5), DimensionKinds())
    )
    timeline.replace(4, np.ones((9, 1)), single_contribution(1, 9))
    assert timeline.fade is not None
    timeline.replace(5, np.ones((9, 1)), single_contribution(1, 9), (PlacedChunk(1, 5, np.ones((9, 1))),))
    assert timeline.fade is None
    timeline.clear()
    assert (timeline.remaining(0), timeline.laid) == (0, ())


def test_a_fade_leaves_the_plan_beneath_as_it_is():
    timeline = Timeline(1)
    timeline.begin_fade(
        Fade(0, np.zeros((4, 1)), tuple(single_contribution(0, 4)), fade_weights(4), DimensionKinds())
    )
    timeline.replace(0, np.ones((4, 1)), single_contribution(1, 4))
    timeline.executed_rows(0)
    timeline.at(0)
    assert (timeline.rows == 1).all()
    assert timeline.plan(0)[1] == single_contribution(1, 4)


def test_shares_of_a_maker_that_comes_from_both_sides_are_added():
    assert mix_contributions(((0, 0.5), (1, 0.5)), ((1, 1.0),), 0.5) == ((0, 0.25), (1, 0.75))
    assert mix_contributions(((1, 1.0),), ((2, 1.0),), 1.0) == ((1, 1.0),)
    assert mix_contributions(((1, 1.0),), ((2, 1.0),), 0.0) == ((2, 1.0),)


@pytest.mark.parametrize("shape", SHAPES)
@given(st.integers(2, 60))
def test_weights_fall_from_exactly_one_to_exactly_nothing(shape, count):
    weights = fade_weights(count, shape)
    assert (weights[0], weights[-1]) == (1.0, 0.0)
    assert (np.diff(weights) <= 0).all()


def test_a_shape_that_does_not_exist_is_refused_by_name():
    with pytest.raises(ValueError, match="'step'; allowed: linear, cosine, exponential"):
        fade_weights(3, "step")


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
    blended, _ = overlap_blend(np.zeros((10, 2)), np.ones((10, 2)), None, DimensionKinds(switched=(1,)))
    assert set(blended[:, 1]) == {1.0}
    assert blended[4, 0] not in (0.0, 1.0)


@pytest.mark.parametrize("shape", SHAPES)
@given(arrays(np.float32, (12, 3), elements=st.floats(-3, 3, width=32)), st.integers(1, 12))
def test_equal_plans_blend_to_the_same_numbers_exactly(shape, rows, window):
    wide = rows.astype(np.float64)
    blended, _ = overlap_blend(wide, wide.copy(), window, DimensionKinds(wrapping=(1,)), shape)
    assert (blended == wide).all()


def test_angles_that_wrap_are_blended_the_shorter_way_round():
    blended, _ = overlap_blend(
        np.full((5, 2), 3.0), np.full((5, 2), -3.0), None, DimensionKinds(wrapping=(1,))
    )
    assert blended[2, 0] == 0.0
    assert blended[2, 1] == pytest.approx(-np.pi)
    assert blended[0, 1] == pytest.approx(3.0 - 2 * np.pi)


@given(st.floats(-20, 20), st.floats(-20, 20))
def test_the_difference_on_the_circle_is_at_most_half_a_turn(old, new):
    apart = difference(np.array([old]), np.array([new]), (0,))[0]
    assert abs(apart) <= np.pi + 1e-9
    assert np.isclose(np.cos(new + apart), np.cos(old), atol=1e-9)


@given(st.lists(st.floats(-9, 9), min_size=1, max_size=8), st.floats(-30, 30))
def test_a_chunk_comes_to_the_branch_of_the_plan_it_joins(angles, before):
    rows = np.column_stack([angles, angles])
    joined = unwrap_onto(rows, np.array([before, before]), (1,))
    assert (joined[:, 0] == rows[:, 0]).all()
    assert abs(joined[0, 1] - before) <= np.pi + 1e-9
    assert (np.abs(np.diff(joined[:, 1])) <= np.pi + 1e-9).all()
    np.testing.assert_allclose(np.sin(joined[:, 1]), np.sin(rows[:, 1]), atol=1e-9)


def test_a_chunk_that_is_on_its_branch_keeps_its_numbers_to_the_bit():
    rows = np.cumsum(np.full((9, 1), 0.1), axis=0)
    assert (unwrap_onto(rows, np.array([0.05]), (0,)) == rows).all()
    assert unwrap_onto(rows, None, ()) is rows
