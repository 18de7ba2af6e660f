import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaweb.results.reports.recompute import methods
from evaweb.statistics.base import StatisticsError
from evaweb.statistics.means import average

# Additional hours of sleep gained (Cushny and Peebles 1905), the example of "Student" 1908.
SLEEP = [1.2, 2.4, 1.3, 1.3, 0.0, 1.0, 1.8, 0.8, 4.6, 1.4]


def test_students_own_example():
    found = average(SLEEP)
    assert found.n == 10
    assert found.value == pytest.approx(1.58)
    assert (found.interval.low, found.interval.high) == pytest.approx((0.7001142, 2.4598858), abs=5e-8)


@pytest.mark.parametrize(
    ("n", "t"), [(2, 12.7062), (3, 4.30265), (6, 2.57058), (10, 2.26216), (121, 1.97993)]
)
def test_the_table_of_t(n, t):
    values = [float(i % 2) for i in range(n)]
    mean = sum(values) / n
    error = math.sqrt(sum((v - mean) ** 2 for v in values) / (n - 1) / n)
    assert (average(values).interval.high - mean) / error == pytest.approx(t, rel=2e-6)
    assert methods.student_t(n - 1) == pytest.approx(t, rel=2e-6)


def test_one_value_and_equal_ones_have_no_interval():
    assert average([]) is None
    assert average([-3.0]).interval is None
    assert average([-3.0] * 5).interval is None
    assert average([-3.0] * 5).n == 5


def test_what_is_no_number_is_refused():
    with pytest.raises(StatisticsError, match="a value of nan"):
        average([1.0, math.nan])


@given(st.lists(st.floats(-100, 0), min_size=1, max_size=60))
def test_the_reports_program_comes_to_the_same(values):
    found, again = average(values), methods.student(values)
    assert again["n"] == found.n
    assert again["mean"] == pytest.approx(found.value, abs=1e-12)
    if found.interval is None:
        assert again["student"] is None
    else:
        ends = (found.interval.low, found.interval.high)
        assert again["student"] == pytest.approx(ends, rel=1e-9, abs=1e-12)
