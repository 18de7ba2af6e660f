from __future__ import annotations

import numpy as np
import pytest

from runtime.core.errors import PolicyError
from runtime.core.types import Conditioning
from runtime.policies.rtc.base import NoRtc


def test_a_plain_server_is_sent_the_observation_alone_and_never_conditioning() -> None:
    plain = NoRtc()
    assert plain.wrap({"state": 1}, None) == {"state": 1}
    assert plain.unwrap({"actions": 1}) == {"actions": 1}
    assert plain.check_supported({"rtc": {"dialect": "prev_action"}}) is False
    with pytest.raises(PolicyError, match="drop RTC conditioning without a word"):
        plain.wrap({}, Conditioning(np.zeros((2, 2), np.float32), 0, 0, 2))


def test_a_server_that_takes_envelopes_alone_is_named() -> None:
    with pytest.raises(PolicyError, match=r"policy.rtc is 'none', allowed with this server: 'async_rtc'"):
        NoRtc().check_supported({"async_rtc": {}})
