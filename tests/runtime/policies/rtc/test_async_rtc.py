from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from runtime.core.errors import PolicyError
from runtime.core.types import Conditioning
from runtime.policies.rtc.async_rtc import AsyncRtc

HEAD = {"protocol": "openpi-async-rtc", "protocol_version": 2}
SAID = {**HEAD, "model_action_horizon": 50, "rtc_supported": True, "image_transport_codecs": ["raw", "jpeg"]}


def committed(count: int = 50, consumed: int = 10, delay: int = 3, horizon: int = 50) -> Conditioning:
    rows = np.arange(2 * count, dtype=np.float32).reshape(count, 2)
    return Conditioning(rows, consumed, delay, horizon)


def connected(**said: Any) -> AsyncRtc:
    dialect = AsyncRtc("linear", 5.0)
    assert dialect.check_supported({"async_rtc": SAID | said})
    return dialect


def rtc_of(conditioning: Conditioning, **said: Any) -> dict[str, Any]:
    return dict(connected(**said).wrap({}, conditioning)["rtc"])


def test_an_envelope_has_a_number_of_its_own_and_raw_pictures() -> None:
    dialect = connected()
    first, second = (dialect.wrap({"state": 1}, None) for _ in range(2))
    assert first == {
        **HEAD,
        "request_id": 0,
        "observation": {"state": 1},
        "image_transport": {"codec": "raw"},
        "rtc": None,
    }
    assert second["request_id"] == 1


def test_all_five_fields_are_sent_with_what_is_left() -> None:
    sent = rtc_of(committed())
    np.testing.assert_array_equal(sent.pop("prev_chunk_left_over"), committed().remaining_rows)
    assert sent == {
        "inference_delay": 3,
        "execution_horizon": 50,
        "prefix_attention_schedule": "linear",
        "max_guidance_weight": 5.0,
    }


@pytest.mark.parametrize(
    ("conditioning", "said", "delay", "horizon"),
    [
        (committed(consumed=45, delay=9), {}, 5, 50),  # no more rows are left
        (committed(delay=9, horizon=4), {}, 9, 9),
        (committed(horizon=50), {"model_action_horizon": 16}, 3, 16),
        (committed(horizon=80), {"model_action_horizon": None}, 3, 50),
    ],
)
def test_delay_and_horizon_stay_in_what_the_server_takes(
    conditioning: Conditioning, said: dict[str, Any], delay: int, horizon: int
) -> None:
    sent = rtc_of(conditioning, **said)
    assert (sent["inference_delay"], sent["execution_horizon"]) == (delay, horizon)


@pytest.mark.parametrize(
    ("metadata", "says"),
    [
        ({"name": "pi0"}, "no async_rtc map, only name"),
        ({}, "only nothing"),
        ({"async_rtc": SAID | {"protocol_version": 1}}, "version 1; needed: 'openpi-async-rtc' version 2"),
        ({"async_rtc": SAID | {"protocol": "mine"}}, "protocol 'mine'"),
        ({"async_rtc": SAID | {"rtc_supported": "yes"}}, "rtc_supported 'yes'; needed: a bool"),
        ({"async_rtc": HEAD}, "rtc_supported None"),
        ({"async_rtc": SAID | {"image_transport_codecs": ["jpeg"]}}, "needed: raw"),
    ],
)
def test_metadata_of_another_server_say_what_was_found(metadata: dict[str, Any], says: str) -> None:
    with pytest.raises(PolicyError, match=says):
        AsyncRtc("exp", 10.0).check_supported(metadata)


def test_a_server_of_a_model_without_rtc_says_so() -> None:
    assert AsyncRtc("exp", 10.0).check_supported({"async_rtc": SAID | {"rtc_supported": False}}) is False


@pytest.mark.parametrize(
    ("reply", "says"),
    [
        ({"result": {}}, "the answer has protocol None version None"),
        ({**HEAD, "protocol_version": 1, "request_id": 0, "result": {}}, "version 1"),
        ({**HEAD, "request_id": 1, "result": {}}, "request_id 1, asked was 0"),
        ({**HEAD, "request_id": 0}, "result that is a NoneType"),
        (
            {**HEAD, "request_id": None, "error": "Traceback\n  x\nKeyError: 'a'"},
            "error: KeyError: 'a'\nTraceback",
        ),
    ],
)
def test_a_reply_that_is_none_is_named(reply: dict[str, Any], says: str) -> None:
    dialect = connected()
    dialect.wrap({}, None)
    with pytest.raises(PolicyError, match=says):
        dialect.unwrap(reply)


def test_the_result_is_what_is_in_the_envelope() -> None:
    dialect = connected()
    dialect.wrap({}, None)
    assert dialect.unwrap({**HEAD, "request_id": 0, "result": {"actions": 1}}) == {"actions": 1}
