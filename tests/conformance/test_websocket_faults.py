"""Every fault against every client on a websocket: an error with a sentence in time, and no thread left."""

from __future__ import annotations

import contextlib
import dataclasses
import socket
import threading
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from runtime import codecs
from runtime.clock import MonotonicClock
from runtime.errors import ContradictionError, PolicyError, PolicyLostError
from runtime.plugins import variants
from runtime.policies.link import PolicyGone, PolicyTimeout
from runtime.policies.websocket import WebsocketPolicy
from runtime.sim.faults import NONE, Fault
from runtime.sim.openpi_server import Behaviour, OpenpiServer
from runtime.sim.roboarena_server import Arena, RoboarenaServer
from runtime.sim.starvla_server import Star, StarvlaServer
from tests.runtime.policies.peers import FRANKA, seen, serving

SIZE = (24, 32)
OBSERVATION = seen(FRANKA)
CAMERAS = [camera.key for camera in FRANKA.cameras]


@dataclasses.dataclass(frozen=True)
class Wire:
    """A protocol: the client's settings, how to start its stand-in, what the server says and answers first."""

    kind: str
    settings: dict[str, Any]
    server: Callable[[Fault], Any]
    metadata: dict[str, Any]


def arena(variant: str, reply: str) -> Callable[[Fault], RoboarenaServer]:
    return lambda fault: RoboarenaServer(
        FRANKA,
        Arena(fault=fault, variant=variant, reply=reply, resolution=SIZE),  # type: ignore[arg-type]
    )


ARENA = {"cameras": {"cam_high": "first", "cam_left_wrist": "wrist"}, "reset_deadline": 0.3}
WIRES = {
    "openpi": Wire("openpi", {}, lambda fault: OpenpiServer(FRANKA, Behaviour(fault=fault)), {}),
    "roboarena": Wire("roboarena", ARENA, arena("roboarena", "bare"), {"needs_wrist_camera": True}),
    "vllm": Wire("roboarena", ARENA, arena("vllm", "dict"), {"needs_wrist_camera": True}),
    "starvla": Wire(
        "starvla",
        {"cameras": CAMERAS, "ping_every": None},
        lambda fault: StarvlaServer(FRANKA, Star(fault=fault, size=SIZE)),
        {"env": "starvla_policy_server"},
    ),
}
MUTE = {"first_inference_deadline": 0.3, "inference_deadline": 0.3, "connect_deadline": 0.5}


@pytest.fixture(autouse=True)
def _no_thread_is_left() -> Iterator[None]:
    before = set(threading.enumerate())
    yield
    for thread in set(threading.enumerate()) - before:
        thread.join(10)
        assert not thread.is_alive(), thread.name


@contextlib.contextmanager
def policy_at(wire: Wire, url: str, **own: Any) -> Iterator[WebsocketPolicy]:
    module = variants("runtime.policies")[wire.kind]
    made = module.Config(**{"url": url, "connect_deadline": 10.0, **wire.settings, **own})
    policy = module.build(made, FRANKA, MonotonicClock(), 30.0)
    assert isinstance(policy, WebsocketPolicy)
    with contextlib.closing(policy):
        yield policy


@contextlib.contextmanager
def served(name: str, fault: Fault = NONE, **own: Any) -> Iterator[WebsocketPolicy]:
    wire = WIRES[name]
    with contextlib.closing(wire.server(fault)) as server:
        url = str(server.start()["url"])
        with policy_at(wire, url, **own) as policy:
            yield policy


def begins_at(policy: WebsocketPolicy, value: float) -> bool:
    rows = policy.infer(seen(FRANKA, value)).actions
    return bool(np.abs(rows[0] - np.clip(value, FRANKA.lower, FRANKA.upper)).max() < 0.05)


def reach_and_ask(policy: WebsocketPolicy) -> None:
    policy.connect()
    policy.infer(OBSERVATION)


def outcome(call: Callable[[], Any]) -> Any:
    """What the call returns, or the PolicyError that it raises; any other error is the test's."""
    try:
        return call()
    except PolicyError as error:
        return error


on_every_wire = pytest.mark.parametrize("name", WIRES)

ON_CONNECT = [
    ("mute_on_connect", PolicyTimeout, "did not send its metadata within"),
    ("text_first", PolicyError, "reports an error: the checkpoint could not be loaded"),
    ("http_404", PolicyError, "HTTP 404"),
]
ON_INFER = [
    ("mute_on_infer:1", PolicyTimeout, r"within 0\.[35] s"),
    ("close_mid_reply:1", PolicyGone, "closed the connection"),
    ("wrong_dim", PolicyError, "rows of 7 numbers; this robot needs 8"),
    ("nan", PolicyError, "nan at row 3, column 2"),
    ("empty", PolicyError, "actions is empty"),
    ("two_batches", PolicyError, r"shape \[2, .*, 8\]"),
    ("bad_array_dialect", PolicyError, "MNP"),
    ("object_array", PolicyError, "refused"),
    ("exception", PolicyError, "CUDA out of memory|Internal inference error"),
]


@on_every_wire
@pytest.mark.parametrize(("fault", "error", "says"), ON_CONNECT, ids=[name for name, *_ in ON_CONNECT])
def test_a_server_that_does_not_greet_is_an_error_in_time(
    name: str, fault: str, error: type[PolicyError], says: str
) -> None:
    with served(name, Fault(fault), connect_deadline=0.5) as policy:
        for _ in range(2):
            with pytest.raises(error, match=says):
                policy.connect()
        with pytest.raises(error, match=says):
            policy.infer(OBSERVATION)


@on_every_wire
@pytest.mark.parametrize(("fault", "error", "says"), ON_INFER, ids=[name for name, *_ in ON_INFER])
def test_an_answer_that_is_none_is_an_error_in_time(
    name: str, fault: str, error: type[PolicyError], says: str
) -> None:
    """Twice: after an error of any kind the next request is one of its own."""
    kind, _, argument = fault.partition(":")
    if name == "starvla" and kind == "exception":
        kind = "refused"  # its server tells errors of a model as a map
    if name == "starvla" and argument:
        argument = "2"  # a ping was the first request
    with served(name, Fault(kind, argument), **MUTE) as policy:
        if argument:
            assert begins_at(policy, 0.1)
        for _ in range(2):
            with pytest.raises(PolicyError, match=says) as raised:
                policy.infer(OBSERVATION)
            assert isinstance(raised.value, error)


@on_every_wire
@pytest.mark.parametrize(("fault", "rows"), [("batched", None), ("single_row", 1)])
def test_one_batch_and_one_row_are_understood(name: str, fault: str, rows: int | None) -> None:
    with served(name, Fault(fault)) as policy:
        actions = policy.infer(OBSERVATION).actions
    assert actions.shape[1] == FRANKA.dim
    assert rows is None or len(actions) == rows


@on_every_wire
def test_a_late_answer_is_never_paired_with_the_next_request(name: str) -> None:
    deadlines = {"first_inference_deadline": 10.0, "inference_deadline": 0.4}
    with served(name, Fault("late_reply", "0.6"), **deadlines) as policy:
        if name != "starvla":  # whose second request this is already: a ping was the first
            assert begins_at(policy, 0.05)
            with pytest.raises(PolicyTimeout):
                policy.infer(seen(FRANKA, 0.5))
        answered = 0
        while answered < 3:
            value = 0.1 * (answered + 1)
            with contextlib.suppress(PolicyLostError):  # the server may still be at what nobody waits for
                assert begins_at(policy, value)
                answered += 1


@on_every_wire
def test_a_reset_while_an_answer_is_in_flight_leaves_both_right(name: str) -> None:
    with served(name) as policy:
        policy.connect()
        policy.infer(OBSERVATION)
        asking = threading.Thread(target=lambda: found.append(begins_at(policy, 0.4)))
        found: list[bool] = []
        asking.start()
        with contextlib.suppress(PolicyLostError):
            policy.reset()
        asking.join(10)
        assert found == [True]
        assert begins_at(policy, 0.2)


@on_every_wire
def test_two_clients_at_one_server_get_their_own_answers(name: str) -> None:
    wire = WIRES[name]
    with contextlib.closing(wire.server(NONE)) as server:
        url = str(server.start()["url"])
        with policy_at(wire, url) as one, policy_at(wire, url) as other:
            for value in (0.1, 0.3):
                assert begins_at(one, value)
                assert begins_at(other, value + 0.1)


@on_every_wire
def test_a_port_where_nobody_listens_is_said_to_be_empty(name: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    with (
        policy_at(WIRES[name], f"ws://127.0.0.1:{port}") as policy,
        pytest.raises(PolicyLostError, match="no policy server listens"),
    ):
        policy.connect()


@pytest.mark.parametrize("server", WIRES)
@on_every_wire
def test_a_server_of_another_protocol_is_named_or_refuses_to_answer(name: str, server: str) -> None:
    """No client takes rows from a server that it does not understand."""
    if WIRES[name].kind == WIRES[server].kind:
        return
    with contextlib.closing(WIRES[server].server(NONE)) as made:
        url = str(made.start()["url"])
        with policy_at(WIRES[name], url) as policy, pytest.raises(PolicyError) as raised:
            reach_and_ask(policy)
    assert not isinstance(raised.value, PolicyLostError)
    assert len(str(raised.value)) > 40


def test_a_contradiction_about_the_action_space_is_found_at_set_up() -> None:
    for name, says in (("openpi", "torque"), ("roboarena", "torque"), ("vllm", "torque")):
        with served(name, Fault("action_mode", "torque")) as policy, pytest.raises(PolicyError, match=says):
            policy.connect()
    with (
        served("roboarena", Fault("action_mode", "joint_velocity")) as policy,
        pytest.raises(ContradictionError, match="joint_velocity"),
    ):
        policy.connect()


# Bytes that nobody has thought of


def _pieces() -> st.SearchStrategy[bytes]:
    """Noise, and real messages cut short or with a byte turned."""
    real = [
        codecs.pack({"actions": np.zeros((2, 8), np.float32)}),
        codecs.pack(
            {"status": "ok", "ok": True, "request_id": "infer-2", "data": {"actions": np.zeros((1, 2, 8))}}
        ),
        codecs.pack(np.zeros((2, 8), np.float32)),
    ]
    cut = st.sampled_from(real).flatmap(lambda m: st.integers(0, len(m) - 1).map(lambda n: m[:n]))
    turned = st.tuples(st.sampled_from(real), st.integers(0, 10_000), st.integers(1, 255)).map(
        lambda t: bytes(byte ^ t[2] if n == t[1] % len(t[0]) else byte for n, byte in enumerate(t[0]))
    )
    return st.one_of(st.binary(max_size=64), cut, turned)


@pytest.mark.parametrize("kind", ["openpi", "roboarena", "starvla"])
@settings(max_examples=60, deadline=None)
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
    wire = next(wire for wire in WIRES.values() if wire.kind == kind)
    module = variants("runtime.policies")[kind]
    return module.build(module.Config(**wire.settings), FRANKA, MonotonicClock(), 30.0)


def _read(policy: Any, kind: str, payload: bytes) -> np.ndarray:
    """What `infer` does with the bytes of an answer."""
    if kind == "openpi":
        return np.asarray(policy._chunk(policy._result(policy._unpacked(payload, "an answer")), 1.0).actions)
    if kind == "roboarena":
        return np.asarray(policy._meant.chunk(policy._value(payload, "an answer"), {}).actions)
    reply = policy._unpacked(payload, "an answer")
    policy._require_answered(reply, {"request_id": "infer-2"})
    return np.asarray(policy._chunk(reply.get("data"), 1.0).actions)


@pytest.mark.parametrize("kind", ["openpi", "roboarena", "starvla"])
@settings(max_examples=60, deadline=None)
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
    found = outcome(lambda: policy._greeted(metadata))
    assert len(str(found)) > 20 if isinstance(found, PolicyError) else found.metadata == metadata


@on_every_wire
def test_a_server_that_sends_noise_first_is_the_wrong_protocol(name: str) -> None:
    with (
        serving(lambda connection: connection.send(b"\xc1\xc1")) as url,
        policy_at(WIRES[name], url) as policy,
        pytest.raises(PolicyError, match="protocol"),
    ):
        policy.connect()
