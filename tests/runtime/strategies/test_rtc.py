import numpy as np

from runtime.strategies import rtc
from runtime.strategies.base import Arrival
from runtime.timeline import Dims, Timeline


def test_its_requests_carry_what_the_robot_is_committed_to():
    assert rtc.query(rtc.Config()).continues
    assert not rtc.query(rtc.Config()).waits


def test_what_is_left_of_a_seam_passes_the_overlap_blend():
    timeline, merge = Timeline(1), rtc.merge(rtc.Config(blend_window=5), Dims())
    merge(timeline, Arrival(1, 0, np.zeros((50, 1))), 0)
    merge(timeline, Arrival(2, 1, np.ones((50, 1))), 4)
    assert timeline.span(4)[0][:6, 0].tolist() == [0, 0.25, 0.5, 0.75, 1, 1]
