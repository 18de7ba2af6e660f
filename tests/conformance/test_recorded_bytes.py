"""Recorded messages of real peers, all of them: read, and where they are ours to write, written byte for byte."""

from __future__ import annotations

import contextlib
import dataclasses
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq

import robots
from runtime.core import msgpack_arrays
from runtime.core.errors import CodecError, PolicyError, ServerReportedError, WrongProtocolError
from runtime.core.types import Conditioning
from runtime.policies.async_inference import messages, pickles
from runtime.policies.groot import arrays as groot
from runtime.policies.rtc.async_rtc import AsyncRtc
from runtime.policies.rtc.prev_action import PrevAction
from runtime.standins import arrays as stand_in
from runtime.standins import gr00t_wire
from runtime.standins.gr00t_server import Gr00tBehaviour, Gr00tServer
from tests.conformance.policies_served import PROTOCOLS, WEBSOCKETS, Served
from tests.runtime.policies.peers import answering, seen, serving

ARM = robots.load_robot("agilex_piper", ["left_arm"])
VECTORS = Path(__file__).parents[1] / "runtime" / "vectors"
LIMIT = 2**20
OPENPI = [
    *(
        "roboarena_metadata",
        "roboarena_infer_request",
        "roboarena_infer_reply_bare",
        "roboarena_infer_reply_dict",
    ),
    *("dreamzero_infer_request_4frames", "starvla_infer_request", "starvla_infer_reply"),
    *("starvla_old_metadata", "starvla_old_infer_reply"),
    *("openpi_infer_request", "openpi_infer_reply", "rtc_a_request_next", "rtc_c_request"),
    *("rtc_d_request_raw", "rtc_d_request_jpeg_first", "rtc_d_reply"),
]
NPY = ["gr00t_n16_get_action_request", "gr00t_n16_get_action_reply"]
MNP = ["gr00t_n17_get_action_request_mnp", "gr00t_n17_get_action_reply_mnp"]
XPOLICYLAB = ["xpolicylab_infer_request", "xpolicylab_infer_reply", "xpolicylab_error"]  # arrays as in MNP
CONFIGURATIONS = ["gr00t_n17_modality_config", "starvla_gr00t_contract"]
PICKLED_ACTIONS = ["lerobot_timed_actions_clones", "lerobot_timed_actions_views", "lerobot_real_server_reply"]
# What our client writes; tests/runtime/policies/async_inference holds that it does.
PICKLED_REQUESTS = [
    "lerobot_timed_observation",
    "lerobot_observation_message",
    "lerobot_remote_policy_config",
]


def vector(name: str) -> bytes:
    return (VECTORS / f"{name}.bin").read_bytes()


def same(one: Any, other: Any) -> bool:
    if isinstance(one, dict):
        return (
            isinstance(other, dict) and list(one) == list(other) and all(same(one[k], other[k]) for k in one)
        )
    if isinstance(one, list):
        return isinstance(other, list) and len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, np.ndarray):
        return isinstance(other, np.ndarray) and one.dtype == other.dtype and bool(np.array_equal(one, other))
    return bool(one == other)


def test_every_recorded_message_is_among_these() -> None:
    named = [
        *OPENPI,
        *NPY,
        *MNP,
        *XPOLICYLAB,
        *CONFIGURATIONS,
        "starvla_gr00t_get_action_reply",
        *PICKLED_ACTIONS,
        *PICKLED_REQUESTS,
    ]
    assert sorted(named) == sorted(path.stem for path in VECTORS.glob("*.bin"))


@pytest.mark.parametrize("name", OPENPI)
def test_openpis_arrays_are_read_and_written_the_same_by_the_clients_and_by_the_stand_ins(name: str) -> None:
    recorded = vector(name)
    read = msgpack_arrays.unpack(recorded)
    assert msgpack_arrays.pack(read) == recorded
    assert stand_in.packed(stand_in.unpacked(recorded)) == recorded
    assert same(read, stand_in.unpacked(recorded))


@pytest.mark.parametrize(("npy", "mnp"), list(zip(NPY, MNP, strict=True)))
def test_gr00ts_arrays_are_the_same_in_both_forms(npy: str, mnp: str) -> None:
    read = groot.unpack(vector(npy), LIMIT)
    assert groot.pack(read) == vector(npy)
    assert groot.pack(read, mnp=True) == vector(mnp)
    assert same(read, groot.unpack(vector(mnp), LIMIT))


@pytest.mark.parametrize("name", XPOLICYLAB)
def test_xpolicylabs_messages_are_the_same_for_the_client_and_for_the_stand_in(name: str) -> None:
    read = groot.unpack(vector(name), LIMIT)
    written = vector(name) if name != "xpolicylab_infer_reply" else groot.pack(read, mnp=True)
    assert groot.pack(read, mnp=True) == written  # its reply has a numpy scalar, which becomes a number
    assert same(read, gr00t_wire.unpacked(written, npy=False))


@pytest.mark.parametrize("name", PICKLED_ACTIONS)
def test_lerobots_actions_are_read(name: str) -> None:
    actions = pickles.load_actions(vector(name), LIMIT)
    steps = [one.timestep for one in actions]
    assert steps == list(range(steps[0], steps[0] + len(steps)))
    assert all(np.isfinite(one.action).all() for one in actions)


@pytest.mark.parametrize("name", PICKLED_REQUESTS)
def test_lerobots_requests_are_no_actions(name: str) -> None:
    with pytest.raises(CodecError):
        pickles.load_actions(vector(name), LIMIT)


@pytest.mark.parametrize("name", [*OPENPI, *NPY, *MNP, *XPOLICYLAB])
def test_a_message_cut_anywhere_is_refused(name: str) -> None:
    recorded = vector(name)
    unpack: Callable[[bytes], Any] = (
        msgpack_arrays.unpack if name in OPENPI else lambda data: groot.unpack(data, LIMIT)
    )
    for size in range(len(recorded)):
        with pytest.raises(CodecError):
            unpack(recorded[:size])


@pytest.mark.some(2)
@pytest.mark.parametrize("name", PICKLED_ACTIONS)
def test_pickled_actions_cut_anywhere_are_refused(name: str) -> None:
    recorded = vector(name)
    for size in range(0, len(recorded), 1 if len(recorded) < 2000 else 23):
        with pytest.raises(CodecError):
            pickles.load_actions(recorded[:size], LIMIT)
    message = messages.encode_setup(recorded)  # of the same form as Actions
    for size in range(1, len(message), 13):
        with pytest.raises(CodecError):
            messages.decode_actions(message[:size])


# Real-time chunking


OBSERVATION = {
    "state": np.array([0.5, 1.0], np.float32),
    "images": {"cam_high": np.arange(12, dtype=np.uint8).reshape(3, 2, 2)},
    "prompt": "pick",
}


def test_the_second_request_with_prev_action_is_the_recorded_one() -> None:
    before = msgpack_arrays.unpack(vector("openpi_infer_reply"))["origin_actions"]
    request = PrevAction().wrap(OBSERVATION, Conditioning(np.array(before), 1, 1, 3))
    assert msgpack_arrays.pack(request) == vector("rtc_a_request_next")
    assert msgpack_arrays.pack(PrevAction().wrap(OBSERVATION, None)) == vector("openpi_infer_request")


def test_an_envelope_has_all_that_the_recorded_one_has() -> None:
    recorded = msgpack_arrays.unpack(vector("rtc_d_request_raw"))
    rows = np.concatenate([np.zeros((1, 2), np.float32), recorded["rtc"]["prev_chunk_left_over"]])
    dialect = AsyncRtc(recorded["rtc"]["prefix_attention_schedule"], recorded["rtc"]["max_guidance_weight"])
    dialect._number, dialect._horizon = 6, 50
    request = dialect.wrap(recorded["observation"], Conditioning(rows, 1, 4, 10))
    assert recorded["image_transport"].pop("jpeg_quality") == 90  # informative
    recorded["rtc"]["inference_delay"] = 2  # no more rows are left; the recorded one says 4 of 2
    assert same(request, recorded)


def test_a_first_envelope_has_no_rtc() -> None:
    recorded = msgpack_arrays.unpack(vector("rtc_d_request_jpeg_first"))
    request = AsyncRtc("exp", 10.0).wrap({}, None)
    assert list(request) == list(recorded)
    assert request["rtc"] is recorded["rtc"] is None
    assert request["request_id"] == recorded["request_id"] == 0


def test_the_recorded_answer_to_an_envelope_is_read_and_only_under_its_number() -> None:
    dialect = AsyncRtc("exp", 10.0)
    dialect._number = 7
    result = dialect.unwrap(msgpack_arrays.unpack(vector("rtc_d_reply")))
    np.testing.assert_array_equal(result["actions"], np.arange(6, dtype=np.float32).reshape(3, 2))
    dialect._number = 8
    with pytest.raises(WrongProtocolError, match="request_id 7"):
        dialect.unwrap(msgpack_arrays.unpack(vector("rtc_d_reply")))


def test_the_recorded_error_in_an_envelope_is_the_servers_own() -> None:
    recorded = bytes.fromhex(
        "84a870726f746f636f6cb06f70656e70692d6173796e632d727463b070726f746f636f6c5f76657273696f6e02"
        "aa726571756573745f696407a56572726f72ad54726163656261636b202e2e2e"
    )
    with pytest.raises(ServerReportedError, match="reports an error: Traceback"):
        AsyncRtc("exp", 10.0).unwrap(msgpack_arrays.unpack(recorded))


# Short messages


def test_the_metadata_of_an_openpi_server_are_read() -> None:
    recorded = bytes.fromhex("81ab616374696f6e5f6d6f6465a471706f73")
    with serving(answering(recorded, lambda _: b"")) as url, PROTOCOLS["openpi"].policy(url) as policy:
        assert policy.connect().metadata == {"action_mode": "qpos"}


@pytest.mark.parametrize(
    ("acknowledgement", "accepted"),
    [
        ("reset successful", True),
        (bytes.fromhex("81a6737461747573b07265736574207375636365737366756c"), True),
        ("Traceback ...", False),
    ],
)
def test_both_acknowledgements_of_a_reset_are_told_from_errors(
    acknowledgement: str | bytes, accepted: bool
) -> None:
    asked: list[bytes] = []
    metadata = msgpack_arrays.unpack(vector("roboarena_metadata")) | {
        "needs_session_id": False,
        "n_external_cameras": 1,
    }
    rows = np.zeros((2, 8), np.float32)

    def answer(message: Any) -> object:
        return acknowledgement if message["endpoint"] == "reset" else rows

    with serving(answering(metadata, answer, asked)) as url, WEBSOCKETS["roboarena"].policy(url) as policy:
        policy.connect()
        policy.infer(seen(WEBSOCKETS["roboarena"].robot))
        with contextlib.nullcontext() if accepted else pytest.raises(PolicyError, match="Traceback"):
            policy.reset()
    assert asked[-1] == bytes.fromhex("81a8656e64706f696e74a57265736574")


@pytest.mark.parametrize(
    ("name", "says"),
    [
        (
            "vllm",
            "82a474797065a56572726f72a76d657373616765b7496e76616c69642072657175657374207061796c6f6164",
        ),
        (
            "starvla",
            "85a6737461747573a56572726f72a26f6bc2a474797065b0696e666572656e63655f726573756c74"
            "aa726571756573745f6964a27231a56572726f7281a76d657373616765a7626164206b6579",
        ),
    ],
)
def test_recorded_errors_are_maps_with_a_sentence(name: str, says: str) -> None:
    message = msgpack_arrays.unpack(bytes.fromhex(says))
    sentence = message["message"] if name == "vllm" else message["error"]["message"]
    assert sentence in ("Invalid request payload", "bad key")
    metadata = {"needs_wrist_camera": True} if name == "vllm" else {"env": "starvla_policy_server"}

    def answer(request: Any) -> object:
        if request.get("type") == "ping":
            return {"status": "ok", "ok": True, "type": "ping", "request_id": request["request_id"]}
        return message | ({"request_id": request["request_id"]} if name == "starvla" else {})

    served = WEBSOCKETS[name]
    with (
        serving(answering(metadata, answer)) as url,
        served.policy(url) as policy,
        pytest.raises(PolicyError, match=sentence),
    ):
        policy.infer(seen(served.robot))


@contextlib.contextmanager
def gr00t(reply: Callable[[bytes], bytes]) -> Iterator[str]:
    """A REP socket that answers as `reply` says."""
    wire: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.REP)
    wire.setsockopt(zmq.LINGER, 0)
    port = wire.bind_to_random_port("tcp://127.0.0.1")
    over = threading.Event()

    def serve() -> None:
        while not over.is_set():
            if wire.poll(20):
                wire.send(reply(wire.recv()))
        wire.close()

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield f"tcp://127.0.0.1:{port}"
    finally:
        over.set()
        thread.join()


SINGLE_ARM = Served(
    "gr00t",
    "tcp",
    lambda fault: Gr00tServer(ARM, Gr00tBehaviour(fault=fault)),
    ARM,
    {
        "video": {"ego_view": "cam_high"},
        "state": {"single_arm": [0, 1, 2, 3, 4, 5]},
        "actions": {"single_arm": [0, 1, 2, 3, 4, 5], "gripper": [6]},
    },
)


@pytest.mark.parametrize(
    ("configuration", "request_", "reply"),
    [
        ("gr00t_n17_modality_config", *MNP),
        ("starvla_gr00t_contract", NPY[0], "starvla_gr00t_get_action_reply"),
    ],
)
def test_a_server_is_asked_in_the_form_that_its_configuration_says(
    configuration: str, request_: str, reply: str
) -> None:
    asked: list[bytes] = []

    def answer(request: bytes) -> bytes:
        asked.append(request)
        return vector(configuration if len(asked) == 1 else reply)

    picture = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
    joints = np.array([0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.0], np.float32)
    shown = seen(ARM, qpos=joints, pictures={"cam_high": picture}, prompt="pick")
    with gr00t(answer) as url, SINGLE_ARM.policy(url) as policy:
        rows = policy.infer(shown).actions
    assert asked[1] == vector(request_)
    np.testing.assert_array_equal(rows[:, :6], np.arange(12, dtype=np.float32).reshape(2, 6) / 8)
    np.testing.assert_array_equal(rows[:, 6], [1.0, 1.0])


def test_a_starvla_server_of_before_may_2026_is_spoken_to() -> None:
    statistics = {"low": [0.0] * 7, "high": [2.0] * 7}
    served = dataclasses.replace(WEBSOCKETS["starvla"], robot=ARM, settings={"cameras": ["cam_high"]})

    def answer(request: Any) -> object:
        if request["type"] == "ping":
            return {"status": "ok", "ok": True, "type": "ping", "request_id": request["request_id"]}
        return msgpack_arrays.unpack(vector("starvla_old_infer_reply")) | {
            "request_id": request["request_id"]
        }

    asked: list[bytes] = []
    with (
        serving(answering(vector("starvla_old_metadata"), answer, asked)) as url,
        served.policy(url, statistics=statistics) as policy,
    ):
        assert policy.connect().metadata == {"env": "simpler_env"}
        rows = policy.infer(seen(ARM)).actions
    expected = 1 + np.minimum(np.arange(14, dtype=np.float32).reshape(2, 7) / 8, 1)
    np.testing.assert_allclose(rows, expected)
    assert msgpack_arrays.unpack(asked[1])["payload"].keys() == {
        "examples"
    }  # nobody said whose statistics there are


def test_gr00ts_short_requests_are_the_recorded_ones() -> None:
    asked: list[bytes] = []

    def reply(request: bytes) -> bytes:
        asked.append(request)
        return groot.pack({"error": "not today"})

    with gr00t(reply) as url, PROTOCOLS["gr00t-n1.6"].policy(url) as policy:
        policy._link.open()  # type: ignore[attr-defined]
        for call in (("get_modality_config", 5.0), ("reset", 5.0, {"options": None})):
            with pytest.raises(PolicyError, match="not today"):
                policy._call(*call)  # type: ignore[attr-defined]
    assert asked == [
        bytes.fromhex("81a8656e64706f696e74b36765745f6d6f64616c6974795f636f6e666967"),
        bytes.fromhex("82a8656e64706f696e74a57265736574a46461746181a76f7074696f6e73c0"),
    ]
