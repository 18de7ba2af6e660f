from hypothesis import given
from hypothesis import strategies as st

from runtime.cameras.live_camera import StreamTime


def test_jitter_of_the_way_is_not_in_the_time_of_capture():
    time = StreamTime()
    late = [0.02, 0.0, 0.05, 0.01, 0.03]
    captured = [time.to_monotonic(k / 30, 100 + k / 30 + extra) for k, extra in enumerate(late)]
    assert [round(t - 100 - k / 30, 9) for k, t in enumerate(captured)][1:] == [0.0] * 4
    assert time.jumps == 0


def test_without_stamps_a_picture_is_taken_when_it_arrives():
    assert StreamTime().to_monotonic(None, 5.25) == 5.25


def test_a_picture_that_was_held_up_is_as_old_as_it_is():
    time = StreamTime()
    time.to_monotonic(0.0, 100.0)
    assert abs(time.to_monotonic(0.1, 103.0) - 100.1) < 1e-9


def test_a_stream_whose_time_goes_back_is_counted_and_mapped_anew():
    time = StreamTime()
    time.to_monotonic(50.0, 100.0)
    assert time.to_monotonic(3.0, 100.1) == 100.1
    assert time.jumps == 1


def test_a_stream_whose_time_leaps_ahead_is_counted_and_not_in_the_future():
    time = StreamTime()
    time.to_monotonic(0.0, 100.0)
    assert time.to_monotonic(60.0, 100.1) == 100.1
    assert abs(time.to_monotonic(60.1, 100.25) - 100.2) < 1e-9
    assert time.jumps == 1


def test_a_stream_that_is_opened_anew_begins_anywhere():
    time = StreamTime()
    time.to_monotonic(50.0, 100.0)
    time.reset()
    assert time.to_monotonic(0.0, 101.0) == 101.0
    assert time.jumps == 0


@given(st.lists(st.tuples(st.floats(-1e6, 1e6), st.floats(0.0, 10.0)), min_size=2, max_size=40))
def test_whatever_a_stream_says_times_increase_and_are_not_after_arrival(pairs):
    time, arrived, before = StreamTime(), 1000.0, float("-inf")
    for stamp, passed in pairs:
        arrived += 1e-3 + passed
        captured = time.to_monotonic(stamp, arrived)
        assert before < captured <= arrived
        before = captured
