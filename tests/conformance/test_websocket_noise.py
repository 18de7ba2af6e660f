"""Bytes that nobody has thought of, where clients on a websocket expect metadata or rows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from websockets.sync.server import ServerConnection

from runtime.core import msgpack_arrays
from runtime.core.clock import MonotonicClock
from runtime.core.errors import PolicyError
from runtime.core.plugins import variants
from runtime.policies.groot import arrays as mnp
from runtime.policies.xpolicy.envelope import Request
from tests.conformance.policies_served import WEBSOCKETS
from tests.examples import some
from tests.runtime.policies.peers import FRANKA, serving


def outcome(call: Callable[[], Any]) -> Any:
    """What the call returns, or the PolicyError that it raises; any other error is the test's."""
    try:
        return call()
    except PolicyError as error:
        return error


def _pieces() -> st.SearchStrategy[bytes]:
    """Noise, and real messages cut short or with a byte turned."""
    real = [
        msgpack_arrays.pack({"actions": np.zeros((2, 8), np.float32)}),
        msgpack_arrays.pack(
            {"status": "ok", "ok": True, "request_id": "infer-2", "data": {"actions": np.zeros((1, 2, 8))}}
        ),
        msgpack_arrays.pack(np.zeros((2, 8), np.float32)),
        mnp.pack(
            {
                "message_type": "infer_result",
                "message_id": "m1",
                "payload": {"actions": [{"arm_joint_state": np.zeros(7), "ee_joint_state": np.zeros(1)}]},
            },
            mnp=True,
        ),
    ]
    cut = st.sampled_from(real).flatmap(lambda m: st.integers(0, len(m) - 1).map(lambda n: m[:n]))
    turned = st.tuples(st.sampled_from(real), st.integers(0, 10_000), st.integers(1, 255)).map(
        lambda t: bytes(byte ^ t[2] if n == t[1] % len(t[0]) else byte for n, byte in enumerate(t[0]))
    )
    return st.one_of(st.binary(max_size=64), cut, turned)


@pytest.mark.parametrize("kind", ["openpi", "roboarena", "starvla", "xpolicylab"])
@settings(max_examples=some(60))
@given(payload=_pieces())
def test_bytes_without_sense_are_a_policy_error_and_never_a_crash(kind: str, payload: bytes) -> None:
    policy: Any = _unconnected(kind)
    found = outcome(lambda: _read(policy, kind, payload))
    if isinstance(found, PolicyError):
        assert len(str(found)) > 20
    else:
        assert found.shape[1] == FRANKA.dim
        assert np.isfinite(found).all()


def _unconnected(kind: str) -> Any:
    served = next(served for served in WEBSOCKETS.values() if served.kind == kind)
    module = variants("runtime.policies")[kind]
    return module.build(module.Config(**served.settings), FRANKA, MonotonicClock(), 30.0)


def _read(policy: Any, kind: str, payload: bytes) -> np.ndarray:
    """What `infer` does with the bytes of an answer."""
    if kind == "openpi":
        return np.asarray(policy._chunk(policy._result(policy._decode(payload, "an answer")), 1.0).actions)
    if kind == "roboarena":
        return np.asarray(policy._meant.chunk(policy._value(payload, "an answer"), {}).actions)
    reply = policy._decode(payload, "an answer")
    if kind == "xpolicylab":
        asked = Request("infer", "eva-web", {}, number="m1")
        asked.is_answered_by(reply)
        return np.asarray(policy._layout.rows(asked.read(reply).get("actions")))
    policy._check_reply(reply, {"request_id": "infer-2"})
    return np.asarray(policy._chunk(reply.get("data"), 1.0).actions)


@pytest.mark.parametrize("kind", ["openpi", "roboarena", "starvla"])
@settings(max_examples=some(60))
@given(
    metadata=st.dictionaries(
        st.sampled_from(
            [
                *(
                    "image_resolution",
                    "n_external_cameras",
                    "needs_wrist_camera",
                    "action_space",
                    "action_dim",
                ),
                *("env", "available_unnorm_keys", "default_unnorm_key", "training_obs_image_size", "rtc"),
                *("action_mode", "action_horizon", "action_chunk_size", "action_keys", "name"),
            ]
        ),
        st.one_of(
            st.none(), st.booleans(), st.integers(-3, 500), st.text(max_size=5), st.lists(st.integers(0, 300))
        ),
    )
)
def test_metadata_without_sense_are_a_policy_error_or_understood(kind: str, metadata: dict[str, Any]) -> None:
    policy: Any = _unconnected(kind)
    policy._ping = lambda seconds: None  # there is no server behind
    found = outcome(lambda: policy._check_metadata(metadata))
    assert len(str(found)) > 20 if isinstance(found, PolicyError) else found.metadata == metadata


@pytest.mark.parametrize("name", WEBSOCKETS)
def test_a_server_that_sends_noise_first_is_the_wrong_protocol(name: str) -> None:
    def noise(connection: ServerConnection) -> None:
        connection.send(b"\xc1\xc1")
        for _ in connection:  # until the client leaves
            pass

    with (
        serving(noise) as url,
        WEBSOCKETS[name].policy(url) as policy,
        pytest.raises(PolicyError, match="protocol"),
    ):
        policy.connect()
