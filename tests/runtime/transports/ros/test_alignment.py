from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.transports.ros.alignment import Aligned, Alignment, Sample

WINDOW = 0.1


def filled(**stamps: list[float]) -> Alignment[float]:
    made: Alignment[float] = Alignment(list(stamps), WINDOW)
    for stream, times in stamps.items():
        for time in times:
            assert made.add(stream, Sample(time, time + 0.01, time))
    return made


def stamps(frame: Aligned[float] | None) -> dict[str, float]:
    assert frame is not None
    return {name: sample.stamp for name, sample in frame.samples.items()}


def test_the_moment_is_the_newest_that_all_streams_have_reached() -> None:
    made = filled(joints=[1.0, 1.01, 1.02, 1.03, 1.04], camera=[0.98, 1.015])
    frame = made.frame()
    assert stamps(frame) == {"joints": 1.01, "camera": 1.015}
    assert frame is not None
    assert frame.time == 1.015


def test_nothing_comes_before_every_stream_has_spoken() -> None:
    made = filled(joints=[1.0, 2.0], camera=[])
    assert made.frame() is None
    assert made.newest_common_time() is None
    made.add("camera", Sample(2.0, 2.0, 0.0))
    assert stamps(made.frame()) == {"joints": 2.0, "camera": 2.0}


def test_streams_that_do_not_belong_together_make_no_frame_until_they_do() -> None:
    made = filled(fast=[1.0, 1.3], slow=[1.15])
    assert made.frame() is None  # 1.15 has been reached, and the fast one is 0.15 s away on both sides
    assert made.unaligned_streams() == ["fast"]
    made.add("slow", Sample(1.29, 1.3, 0.0))
    assert stamps(made.frame()) == {"fast": 1.3, "slow": 1.29}
    assert made.unaligned_streams() == []


def test_readers_take_nothing_from_each_other() -> None:
    made = filled(joints=[1.0], camera=[1.0])
    first = made.frame()
    assert first is not None
    assert made.frame() == first
    assert made.frame(after=first) is None
    made.add("joints", Sample(1.05, 1.05, 0.0))
    assert made.frame(after=first) is None  # the camera has not reached it
    made.add("camera", Sample(1.06, 1.06, 0.0))
    assert stamps(made.frame(after=first)) == {"joints": 1.05, "camera": 1.06}
    assert stamps(made.frame()) == {"joints": 1.05, "camera": 1.06}


def test_the_same_samples_are_no_new_frame_at_a_later_moment() -> None:
    made = filled(joints=[1.0], camera=[1.02])
    first = made.frame()
    made.add(
        "joints", Sample(1.05, 1.05, 0.0)
    )  # all have reached 1.02 now, and the joints of 1.0 are nearest
    assert stamps(made.frame()) == {"joints": 1.0, "camera": 1.02}
    assert made.frame(after=first) is None
    made.add("camera", Sample(1.06, 1.06, 0.0))
    assert stamps(made.frame(after=first)) == {"joints": 1.05, "camera": 1.06}


def test_a_sample_that_is_not_newer_is_left_out() -> None:
    made = filled(joints=[1.0])
    assert not made.add("joints", Sample(1.0, 2.0, 5.0))
    assert not made.add("joints", Sample(0.5, 2.0, 5.0))
    newest = made.newest("joints")
    assert newest is not None
    assert newest.value == 1.0


def test_a_stalled_stream_makes_no_other_one_grow() -> None:
    made: Alignment[float] = Alignment(["joints", "camera"], WINDOW, 1.0, {"camera": 32})
    made.add("joints", Sample(0.0, 0.0, 0.0))
    for number in range(10_000):
        made.add("camera", Sample(number / 1000, 0.0, 0.0))
    assert len(made._samples["camera"]) == 32
    made.clear()
    for number in range(10_000):
        made.add("joints", Sample(number / 1000, 0.0, 0.0))
    assert len(made._samples["joints"]) == 1001
    assert made.frame() is None


times = st.lists(st.integers(0, 3000), min_size=1, max_size=40, unique=True).map(sorted)


@given(st.dictionaries(st.sampled_from("abcd"), times, min_size=1))
def test_a_frame_is_bounded_nearest_and_at_the_newest_common_moment(streams: dict[str, list[int]]) -> None:
    made = filled(**{name: [t / 1000 for t in ticks] for name, ticks in streams.items()})
    moment = min(max(ticks) for ticks in streams.values()) / 1000
    frame = made.frame()
    kept = {
        name: [t / 1000 for t in ticks if t / 1000 >= max(ticks) / 1000 - 1.0]
        for name, ticks in streams.items()
    }
    nearest = {name: min(abs(t - moment) for t in ticks) for name, ticks in kept.items()}
    if frame is None:
        assert max(nearest.values()) > WINDOW
        assert set(made.unaligned_streams()) == {
            name for name, distance in nearest.items() if distance > WINDOW
        }
        return
    assert frame.time == moment
    for name, stamp in stamps(frame).items():
        assert math.isclose(abs(stamp - moment), nearest[name], abs_tol=1e-12)
        assert abs(stamp - moment) <= WINDOW


def test_a_stream_that_is_unknown_is_an_error_of_ours() -> None:
    with pytest.raises(KeyError):
        filled(joints=[1.0]).add("other", Sample(1.0, 1.0, 0.0))
