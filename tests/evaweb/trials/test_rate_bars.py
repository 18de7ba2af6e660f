import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaweb.statistics.proportions import proportion
from evaweb.trials.rate_bars import format_interval, format_percent, rate_bar


@given(st.integers(1, 300).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_a_bar_stays_on_its_axis_and_its_mark_within_its_band(counts):
    drawn = rate_bar(proportion(*counts))
    assert 6 <= drawn.low <= drawn.rate <= drawn.high <= 194
    assert drawn.span == pytest.approx(drawn.high - drawn.low, abs=0.01)


def test_nothing_is_drawn_where_nothing_is_known():
    assert rate_bar(proportion(0, 0)) is None
    assert format_interval(proportion(0, 0)) == ""


def test_words_say_what_the_bar_shows():
    assert rate_bar(proportion(8, 10)).words == "80 % of 10, 95 % interval 49 to 94"
    assert format_percent(1.0) == "100 %"
