from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.core.errors import ConfigurationError, ContradictionError, PolicyError
from runtime.core.types import Conditioning
from runtime.policies.rtc.openpi_rtc import EnvelopeKeys, OpenpiRtc

ANCESTOR = EnvelopeKeys(server_shift=25)
FORK = EnvelopeKeys(observation="observation", flag="use_rtc", shift="s_param", delay="d_param")


def committed(count: int = 50, consumed: int = 25) -> Conditioning:
    rows = np.arange(2 * count, dtype=np.float32).reshape(count, 2)
    return Conditioning(rows, consumed, 3, count)


def test_the_first_request_has_no_chunk() -> None:
    assert OpenpiRtc(ANCESTOR, "aligned").wrap({"state": 1}, None) == {
        "obs": {"state": 1},
        "is_rtc": False,
    }
    assert OpenpiRtc(FORK, "aligned").wrap({"state": 1}, None) == {
        "observation": {"state": 1},
        "use_rtc": False,
    }


def test_where_the_robot_consumed_what_the_server_takes_off_the_chunk_goes_back_as_it_came() -> None:
    request = OpenpiRtc(ANCESTOR, "aligned").wrap({}, committed(50, 25))
    assert list(request) == ["obs", "prev_action", "is_rtc"]
    np.testing.assert_array_equal(request["prev_action"], committed().previous)
    assert request["prev_action"].dtype == np.float32


@given(
    st.integers(1, 60).flatmap(lambda n: st.tuples(st.just(n), st.integers(0, n - 1), st.integers(0, n - 1)))
)
def test_the_server_always_continues_from_the_first_row_that_is_left(shape: tuple[int, int, int]) -> None:
    count, consumed, shift = shape
    conditioning = committed(count, consumed)
    sent = OpenpiRtc(EnvelopeKeys(server_shift=shift), "aligned").wrap({}, conditioning)["prev_action"]
    seen, left = sent[shift:], conditioning.remaining_rows
    shared = min(len(seen), len(left))
    np.testing.assert_array_equal(seen[:shared], left[:shared])
    assert (seen[shared:] == left[-1]).all()
    assert sent.shape == conditioning.previous.shape


def test_a_fork_that_is_told_gets_the_whole_chunk_and_the_numbers() -> None:
    request = OpenpiRtc(FORK, "aligned").wrap({}, committed(50, 7))
    np.testing.assert_array_equal(request["prev_action"], committed().previous)
    assert (request["use_rtc"], request["s_param"], request["d_param"]) == (True, 7, 3)


def test_the_whole_chunk_is_sent_where_that_is_wanted() -> None:
    request = OpenpiRtc(EnvelopeKeys(), "whole").wrap({}, committed(50, 7))
    np.testing.assert_array_equal(request["prev_action"], committed().previous)


def test_how_many_rows_the_server_takes_off_has_to_be_said() -> None:
    with pytest.raises(ConfigurationError, match="allowed: server_shift = 25"):
        OpenpiRtc(EnvelopeKeys(), "aligned")


@pytest.mark.parametrize(
    ("metadata", "expected"),
    [
        ({}, None),
        ({"rtc": {"dialect": "openpi_rtc", "shift": 25}}, True),
        ({"rtc": {"dialect": "openpi_rtc"}}, True),
        ({"rtc": {"dialect": "kai0"}}, False),
    ],
)
def test_most_servers_do_not_say_and_the_bundled_one_does(
    metadata: dict[str, Any], expected: bool | None
) -> None:
    assert OpenpiRtc(ANCESTOR, "aligned").check_supported(metadata) is expected


def test_a_server_that_takes_off_another_number_or_wants_envelopes_is_refused() -> None:
    with pytest.raises(ContradictionError, match=r"rtc\.shift = 10, .*server_shift = 25"):
        OpenpiRtc(ANCESTOR, "aligned").check_supported({"rtc": {"dialect": "openpi_rtc", "shift": 10}})
    with pytest.raises(
        PolicyError, match=r"policy\.rtc is 'openpi_rtc', allowed with this server: 'async_rtc'"
    ):
        OpenpiRtc(ANCESTOR, "aligned").check_supported({"async_rtc": {}})


def test_the_reply_is_the_result() -> None:
    assert OpenpiRtc(ANCESTOR, "aligned").unwrap({"actions": 1}) == {"actions": 1}
