from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runtime.core import msgpack_arrays
from runtime.core.errors import PolicyError
from runtime.core.types import Conditioning
from runtime.policies.rtc.kai0 import Kai0

VECTORS = Path(__file__).parents[2] / "vectors"


def committed(count: int = 50, consumed: int = 10, delay: int = 3, horizon: int = 50) -> Conditioning:
    rows = np.arange(2 * count, dtype=np.float32).reshape(count, 2)
    return Conditioning(rows, consumed, delay, horizon)


def test_the_request_of_its_own_client_is_reproduced_byte_for_byte() -> None:
    recorded = (VECTORS / "rtc_c_request.bin").read_bytes()
    message = msgpack_arrays.unpack(recorded)
    observation = {key: message[key] for key in ("state", "images", "prompt")}
    rows = np.array(message["prev_action_chunk"], np.float32)[:, :2]
    weight = message["max_guidance_weight"]
    request = Kai0("whole", weight).wrap(observation, Conditioning(rows, 1, 3, 8))
    assert msgpack_arrays.pack(request) == recorded


def test_the_first_request_lacks_only_the_chunk() -> None:
    assert Kai0("aligned", 0.5).wrap({"state": 1}, None) == {
        "state": 1,
        "inference_delay": 0,
        "execute_horizon": 1,
        "enable_rtc": True,
        "mask_prefix_delay": False,
        "max_guidance_weight": 0.5,
    }


def test_row_n_is_for_the_step_that_row_n_of_the_answer_is_for() -> None:
    conditioning = committed(consumed=10)
    rows = np.array(Kai0("aligned", 0.5).wrap({}, conditioning)["prev_action_chunk"])
    assert rows.shape == (50, 32)
    np.testing.assert_array_equal(rows[:40, :2], conditioning.remaining_rows)
    assert (rows[40:, :2] == conditioning.previous[-1]).all()
    assert not rows[:, 2:].any()


@pytest.mark.parametrize(
    ("conditioning", "delay", "end"),
    [
        (committed(), 3, 40),  # rows that only repeat the last one are no plan to follow
        (committed(horizon=8), 3, 8),
        (committed(consumed=48, delay=9), 9, 9),
    ],
)
def test_what_only_repeats_the_last_row_is_not_followed(
    conditioning: Conditioning, delay: int, end: int
) -> None:
    request = Kai0("aligned", 0.5).wrap({}, conditioning)
    assert (request["inference_delay"], request["execute_horizon"]) == (delay, end)


def test_wide_rows_are_cropped_to_the_models() -> None:
    rows = np.ones((4, 40), np.float32)
    sent = Kai0("whole", 0.5).wrap({}, Conditioning(rows, 0, 0, 4))["prev_action_chunk"]
    assert {len(row) for row in sent} == {32}


@pytest.mark.parametrize(
    ("metadata", "expected"),
    [({}, None), ({"rtc": {"dialect": "kai0"}}, True), ({"rtc": {"dialect": "none"}}, False)],
)
def test_most_servers_do_not_say_and_the_bundled_one_does(
    metadata: dict[str, Any], expected: bool | None
) -> None:
    assert Kai0("aligned", 0.5).check_supported(metadata) is expected


def test_a_server_that_wants_envelopes_is_refused() -> None:
    with pytest.raises(PolicyError, match=r"policy\.rtc is 'kai0', allowed with this server: 'async_rtc'"):
        Kai0("aligned", 0.5).check_supported({"async_rtc": {}})


def test_the_reply_is_the_result() -> None:
    assert Kai0("aligned", 0.5).unwrap({"actions": 1}) == {"actions": 1}
