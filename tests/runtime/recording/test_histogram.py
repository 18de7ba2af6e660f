import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.recording.encoder import DurationHistogram


@given(st.lists(st.floats(1e-3, 1e3), min_size=1, max_size=300))
def test_quantiles_are_those_of_the_durations_to_one_per_cent(durations: list[float]) -> None:
    spread = DurationHistogram()
    for seconds in durations:
        spread.add(seconds)
    told = spread.milliseconds()
    assert told is not None
    for name, percent in (("p50", 50), ("p99", 99)):
        exact = float(np.percentile(durations, percent, method="inverted_cdf")) * 1000.0
        assert told[name] == pytest.approx(exact, rel=0.011)
    assert told["max"] == max(durations) * 1000.0
    assert told["p50"] <= told["p99"] <= told["max"]


def test_what_is_not_known_does_not_count_and_extremes_do() -> None:
    spread = DurationHistogram()
    for unknown in (math.nan, math.inf, -math.inf):
        spread.add(unknown)
    assert spread.milliseconds() is None
    for seconds in (0.0, -1.0, 1e9):
        spread.add(seconds)
    told = spread.milliseconds()
    assert told is not None
    assert told["max"] == 1e12
