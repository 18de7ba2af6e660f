from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.core.errors import PolicyError
from runtime.core.types import Conditioning
from runtime.policies.rtc.prev_action import PrevAction


def committed(count: int, consumed: int) -> Conditioning:
    rows = np.arange(2 * count, dtype=np.float32).reshape(count, 2)
    return Conditioning(rows, consumed, 3, count)


@given(st.integers(1, 60).flatmap(lambda count: st.tuples(st.just(count), st.integers(0, count - 1))))
def test_what_is_left_is_padded_with_its_last_row_to_the_length_of_the_chunk(shape: tuple[int, int]) -> None:
    conditioning = committed(*shape)
    request = PrevAction().wrap({"state": 1}, conditioning)
    sent, left = request["prev_action"], conditioning.remaining_rows
    assert sent.dtype == np.float32
    assert sent.shape == conditioning.previous.shape
    np.testing.assert_array_equal(sent[: len(left)], left)
    assert (sent[len(left) :] == left[-1]).all()
    assert request["rtc_params"] == {"s": shape[1]}
    assert request["state"] == 1


def test_the_first_request_has_neither_key() -> None:
    assert PrevAction().wrap({"state": 1}, None) == {"state": 1}


@pytest.mark.parametrize(
    ("metadata", "expected"),
    [({}, None), ({"rtc": {"dialect": "prev_action"}}, True), ({"rtc": {"dialect": "none"}}, False)],
)
def test_most_servers_do_not_say_and_the_bundled_one_does(
    metadata: dict[str, object], expected: bool | None
) -> None:
    assert PrevAction().check_supported(metadata) is expected


@pytest.mark.parametrize(
    ("metadata", "says"),
    [
        ({"async_rtc": {}}, "policy.rtc is 'prev_action', allowed with this server: 'async_rtc'"),
        ({"rtc": True}, "rtc = True; expected a map with a dialect"),
        ({"rtc": {}}, "expected a map with a dialect"),
    ],
)
def test_a_server_of_another_dialect_is_named(metadata: dict[str, object], says: str) -> None:
    with pytest.raises(PolicyError, match=says):
        PrevAction().check_supported(metadata)
