from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import robots
from runtime.core.pose_format import OrientationName, PoseFormat
from runtime.core.types import ActionChunk, Conditioning
from runtime.ipc.messages import MergeResult
from runtime.kinematics.base import ChainForward
from runtime.motion.timeline import DimensionKinds
from runtime.processes.coordinator.inference.chunk_mixture import Mixture
from runtime.processes.coordinator.inference.rtc_prefix import RtcPrefix
from runtime.spaces.end_effectors import EndEffectors
from runtime.spaces.pose_rows import PoseRows

RATE = 30.0
ALONE = np.zeros((0, 3))  # no step that another chunk has a part in


def rows(count: int, width: int = 2, first: float = 0.0) -> np.ndarray:
    """Rows that say which they are."""
    return np.repeat(first + np.arange(count, dtype=np.float32)[:, None], width, axis=1)


def merged(
    number: int, observation_step: int, delay: int, count: int = 50, mistimed: int = 0, dropped: str = ""
) -> MergeResult:
    """As control tells of rows from `observation_step` on; what is stale is told as what is not."""
    targets = observation_step + mistimed + np.arange(count)
    return MergeResult(
        number, observation_step + delay, delay, targets, mistimed, dropped, 1, contributions=ALONE
    )


def committed(
    chunk: ActionChunk | None = None, step: int = 100, delay: int = 3, waited: bool = False, mistimed: int = 0
) -> RtcPrefix:
    """A commitment to one chunk that answers the observation of `step`."""
    made, chunk = RtcPrefix(RATE), chunk or ActionChunk(rows(50))
    made.add_chunk(1, chunk, step, waited)
    count = int(len(chunk.actions) * RATE / (chunk.rate or RATE))
    made.on_merged(merged(1, step + delay if waited else step, 0 if waited else delay, count, mistimed))
    return made


def asked(
    held: RtcPrefix, step: int, delays: list[int] | None = None, horizon: int | None = None
) -> Conditioning:
    found = held.conditioning(step, [3] if delays is None else delays, 0.9, horizon)
    assert found is not None
    return found


# What is left


def test_nobody_is_committed_to_anything_before_a_chunk_was_merged() -> None:
    held = RtcPrefix(RATE)
    assert held.conditioning(100, [3], 0.9, None) is None
    held.add_chunk(1, ActionChunk(rows(50)), 100)
    assert held.conditioning(104, [3], 0.9, None) is None


@given(st.integers(0, 40), st.integers(0, 40), st.integers(1, 90))
def test_what_is_left_begins_with_the_row_for_the_observation_whatever_the_delay(
    delay: int, since: int, count: int
) -> None:
    """The bad design shifts by a constant, or counts from the arrival."""
    later = delay + since
    held = committed(ActionChunk(rows(count)), delay=delay)
    found = held.conditioning(100 + later, [delay], 0.9, None)
    if later >= count:
        assert found is None
    else:
        assert found is not None
        assert found.consumed_rows == later
        np.testing.assert_array_equal(found.remaining_rows, rows(count)[later:])


def test_a_chunk_that_was_shifted_counts_from_where_it_was_put() -> None:
    assert asked(committed(delay=9, mistimed=4), 110).remaining_rows[0, 0] == 6


def test_a_chunk_that_the_robot_waited_for_counts_from_its_arrival() -> None:
    held = committed(delay=60, waited=True)
    assert asked(held, 170).remaining_rows[0, 0] == 10


@given(st.integers(1, 5), st.booleans())
def test_of_a_step_before_its_first_one_nothing_is_said(early: int, waited: bool) -> None:
    """The robot was told something else then, and no row says what."""
    held = committed(delay=6, waited=waited)
    assert held.conditioning(106 - early, [3], 0.9, None) is None
    assert asked(held, 106).remaining_rows[0, 0] == (0 if waited else 6)


def test_the_newest_merged_chunk_counts_and_what_was_dropped_does_not() -> None:
    held = committed()
    held.add_chunk(2, ActionChunk(rows(50, first=200)), 110)
    held.add_chunk(3, ActionChunk(rows(50, first=300)), 120)
    held.on_merged(merged(2, 110, 3))
    held.on_merged(merged(3, 120, 60, dropped="60 rows are stale"))
    assert asked(held, 125).remaining_rows[0, 0] == 215


def test_rows_of_the_models_own_space_go_before_actions() -> None:
    chunk = ActionChunk(rows(50), model_actions=rows(50, 32, first=0.5))
    found = asked(committed(chunk), 110)
    assert found.previous.shape == (50, 32)
    assert found.remaining_rows[0, 0] == 10.5


def test_rows_without_an_action_do_not_count_as_left() -> None:
    held = committed(ActionChunk(rows(10), model_actions=rows(50, 32)))
    assert asked(held, 109).consumed_rows == 9
    assert held.conditioning(110, [3], 0.9, None) is None


# Rates


@given(st.floats(3, 120), st.integers(0, 50), st.integers(0, 40))
def test_at_another_rate_what_is_left_begins_exactly_at_the_observation(
    rate: float, since: int, delay: int
) -> None:
    held = committed(ActionChunk(rows(400), rate=rate))
    found = held.conditioning(103 + since, [delay], 0.9, None)
    assert found is not None
    assert abs(found.consumed_rows / rate - (3 + since) / RATE) <= 0.5 / rate + 1e-6
    passed = (3 + since) * rate / RATE + np.arange(found.predicted_delay)
    np.testing.assert_allclose(found.remaining_rows[: found.predicted_delay, 0], passed, rtol=1e-6, atol=1e-5)
    assert -1e-6 <= found.predicted_delay - delay * rate / RATE < 1 + 1e-6


# The predicted delay


def test_a_high_quantile_of_the_measured_delays_is_predicted() -> None:
    delays = [3] * 18 + [4, 9]
    assert asked(committed(), 110, delays).predicted_delay == 4
    held = committed()
    found = held.conditioning(110, delays, 1.0, None)
    assert found is not None
    assert found.predicted_delay == held.predicted_delay == 9


def test_the_chunks_own_delay_is_predicted_where_no_other_was_measured() -> None:
    assert asked(committed(delay=7), 110, []).predicted_delay == 7


@given(
    st.sampled_from([None, 10.0, 12.0, 24.0, 75.0]),
    st.integers(3, 90),
    st.integers(0, 60),
    st.integers(3, 89),
    st.one_of(st.none(), st.integers(1, 80)),
)
def test_all_that_is_predicted_and_planned_is_fixed_and_it_warns_where_the_answer_comes_after_the_plan(
    rate: float | None, planned: int, delay: int, later: int, horizon: int | None
) -> None:
    """Whatever the horizon is now: what was planned with another one stays planned, and rates have no row per step."""
    pace = 1.0 if rate is None else rate / RATE
    held = RtcPrefix(RATE)
    held.add_chunk(1, ActionChunk(rows(math.ceil((planned - 1) * pace) + 1), rate=rate), 100)
    held.on_merged(merged(1, 100, 3, planned))
    found = held.conditioning(100 + later, [delay], 0.9, horizon)
    assert (found is None) == (later >= planned)
    if found is not None:
        wanted = min(math.ceil(delay * pace - 1e-9), math.floor((planned - 1 - later) * pace + 1e-9) + 1)
        assert found.predicted_delay == wanted
        meant = later * pace + np.arange(wanted)
        np.testing.assert_allclose(found.remaining_rows[:wanted, 0], meant, atol=1e-4)
        assert bool(held.warning) == (delay > planned - later)


def test_the_horizon_is_that_of_the_answer_in_its_rows() -> None:
    assert asked(committed(), 110, None, 20).execution_horizon == 20
    assert asked(committed(), 110, None, 80).execution_horizon == 50
    assert asked(committed(ActionChunk(rows(50), rate=10.0)), 110, None, 20).execution_horizon == 7


def test_the_warning_says_the_numbers() -> None:
    held = committed(ActionChunk(rows(20)))
    asked(held, 110, [12])
    assert "expected after 12 steps, but 10 are planned" in held.warning
    asked(held, 105, [12])
    assert held.warning == ""


# Resets


def test_a_reset_forgets_what_was_merged_and_what_was_on_its_way() -> None:
    held = committed()
    held.add_chunk(2, ActionChunk(rows(50)), 110)
    held.clear()
    held.on_merged(merged(2, 110, 3))
    assert held.conditioning(115, [3], 0.9, None) is None


def test_a_reply_that_was_in_flight_at_a_reset_never_counts() -> None:
    held = committed()
    sent_in = held.generation
    held.clear()
    held.add_chunk(2, ActionChunk(rows(50)), 110, generation=sent_in)
    held.on_merged(merged(2, 110, 3))
    assert held.conditioning(115, [3], 0.9, None) is None
    held.add_chunk(3, ActionChunk(rows(50)), 120, generation=held.generation)
    held.on_merged(merged(3, 120, 3))
    assert asked(held, 125).consumed_rows == 5


events = st.lists(
    st.tuples(st.sampled_from(["ask", "answer", "merge", "drop", "clear"]), st.integers(0, 3)), max_size=30
)


@given(events)
def test_only_an_answer_asked_for_and_merged_since_the_last_reset_counts(
    given_: list[tuple[str, int]],
) -> None:
    held = RtcPrefix(RATE)
    expected: int | None = None
    asked_in: dict[int, int] = {}
    answered_in: dict[int, int] = {}
    cleared = 0
    for what, number in given_:
        if what == "ask":
            asked_in[number] = cleared
        elif what == "answer" and number in asked_in:
            chunk = ActionChunk(rows(50, first=1000.0 * number))
            held.add_chunk(number, chunk, 100, generation=asked_in[number])
            if asked_in.pop(number) == cleared:
                answered_in[number] = cleared
        elif what in ("merge", "drop"):
            held.on_merged(merged(number, 100, 3, dropped="late" if what == "drop" else ""))
            fresh = answered_in.pop(number, None) == cleared
            if what == "merge" and fresh and (expected is None or number >= expected):
                expected = number
        elif what == "clear":
            held.clear()
            cleared += 1
            expected = None
            answered_in.clear()
    found = held.conditioning(105, [3], 0.9, None)
    assert (found is None) == (expected is None)
    if found is not None and expected is not None:
        assert found.remaining_rows[0, 0] == pytest.approx(1000.0 * expected + 5)


# What control has blended


def blended(first: ActionChunk, second: ActionChunk, shares: list[list[float]], **settings: Any) -> RtcPrefix:
    """A commitment to a chunk for step 100, and from 105 on to one for step 102, as far as `shares` do not say else."""
    held = RtcPrefix(RATE, Mixture(**settings))
    held.add_chunk(1, first, 100)
    held.on_merged(merged(1, 100, 0, len(first.actions)))
    held.add_chunk(2, second, 102)
    told = merged(2, 102, 3, len(second.actions))
    held.on_merged(replace(told, contributions=np.array(shares).reshape(-1, 3)))
    return held


HALF = [[105, 1, 1.0], [106, 1, 0.5], [106, 2, 0.5]]


def test_rows_that_control_has_blended_are_given_back_as_they_became() -> None:
    held = blended(ActionChunk(rows(50)), ActionChunk(rows(50, first=200)), HALF)
    assert asked(held, 105).remaining_rows[:4, 0].tolist() == [5.0, (6.0 + 204.0) / 2, 205.0, 206.0]
    assert asked(held, 103).remaining_rows[:4, 0].tolist() == [
        3.0,
        4.0,
        5.0,
        105.0,
    ]  # also of the plan before


def test_the_models_own_rows_are_mixed_by_the_same_weights() -> None:
    first = ActionChunk(rows(50), model_actions=rows(50, 32, first=0.5))
    second = ActionChunk(rows(50, first=200), model_actions=rows(50, 32, first=20))
    held = blended(first, second, HALF, dims=DimensionKinds(switched=(1,)))
    left = asked(held, 105).remaining_rows
    assert left[:3, 0].tolist() == [5.5, (6.5 + 24.0) / 2, 25.0]
    assert left[:3, 1].tolist() == [5.5, 24.0, 25.0]  # a binary gripper does not lie in between
    assert left.shape[1] == 32


def test_angles_without_limits_mix_the_shorter_way_round_and_in_the_models_own_numbers_not_at_all() -> None:
    first, second = (np.full((50, 2), angle, np.float32) for angle in (3.1, -3.1))
    shares = [[105, 1, 0.5], [105, 2, 0.5]]
    held = blended(ActionChunk(first), ActionChunk(second), shares, dims=DimensionKinds(wrapping=(0,)))
    mixed = asked(held, 105).remaining_rows[0]
    np.testing.assert_allclose(mixed, [-np.pi, 0.0], atol=1e-6)
    own = (ActionChunk(angles, model_actions=rows(50, 32)) for angles in (first, second))
    held = blended(*own, shares, dims=DimensionKinds(wrapping=(0,)))
    assert held.conditioning(105, [3], 0.9, None) is None
    assert asked(held, 106).remaining_rows[0, 0] == 4.0


@pytest.mark.parametrize("orientation", ["wxyz", "euler", "rotation_vector", "6d"])
def test_blended_poses_are_those_of_the_blended_joints(orientation: OrientationName) -> None:
    robot, pose = robots.load_robot("agilex_piper"), PoseFormat(orientation=orientation)
    layout, ends = PoseRows(pose, robot), EndEffectors(robot, ChainForward(robot))
    joints = [np.tile(robot.poses["ready"] + apart, (50, 1)) for apart in (0.0, 0.2)]

    def chunk(at: np.ndarray) -> ActionChunk:
        return ActionChunk(layout.encode(ends.vectors(at), at).astype(np.float32), "eef", pose=pose)

    held = RtcPrefix(RATE, Mixture(robot=robot))
    for number, at in enumerate(joints, 1):
        held.add_chunk(number, chunk(at), 100, commands=at)
        held.on_merged(
            replace(merged(number, 100, number), contributions=np.array([[105, 1, 0.5], [105, number, 0.5]]))
        )
    between = chunk((joints[0] + joints[1]) / 2)
    np.testing.assert_allclose(asked(held, 105).remaining_rows[0], between.actions[0], atol=1e-6)
    np.testing.assert_array_equal(asked(held, 105).remaining_rows[1:], chunk(joints[1]).actions[6:])


@pytest.mark.parametrize("shares", [[[106, 0, 0.5], [106, 2, 0.5]], [[106, 7, 1.0]], None])
def test_of_a_held_target_of_an_unknown_chunk_and_of_what_was_not_told_nothing_is_said(
    shares: list[list[float]] | None,
) -> None:
    held = blended(ActionChunk(rows(50)), ActionChunk(rows(50)), shares or [])
    if shares is None:
        held.add_chunk(3, ActionChunk(rows(50)), 104)
        held.on_merged(replace(merged(3, 104, 2), contributions=None))
    assert held.conditioning(106, [3], 0.9, None) is None


def test_answers_in_other_numbers_are_not_mixed() -> None:
    held = blended(ActionChunk(rows(50)), ActionChunk(rows(50), model_actions=rows(50, 32)), HALF)
    assert held.conditioning(105, [3], 0.9, None) is None
    assert asked(held, 107).remaining_rows[0, 0] == 5.0
