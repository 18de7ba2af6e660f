from __future__ import annotations

import contextlib
import threading
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from websockets.sync.server import ServerConnection

from runtime.core import msgpack_arrays
from runtime.core.clock import MonotonicClock
from runtime.core.errors import ConfigurationError, ContradictionError, PolicyError, PolicyLostError
from runtime.core.pose_format import PoseFormat
from runtime.core.types import Conditioning, Observation
from runtime.policies import starvla
from runtime.policies.starvla import Config, StarvlaPolicy
from runtime.standins.faults import NONE, Fault
from runtime.standins.starvla_server import StarvlaBehaviour, StarvlaServer
from tests.processes import PATIENCE_S, joined
from tests.runtime.policies.peers import FRANKA, PIPER, Handler, seen, serving

VECTORS = Path(__file__).parents[1] / "vectors"
VIEWS = ["cam_left_wrist", "cam_high"]
SAID = {"env": "starvla_policy_server", "ckpt_path": "lab/model", "action_chunk_size": 2}
ROWS = np.arange(16, dtype=np.float64).reshape(2, 8) / 8


def built(robot: Any = FRANKA, **settings: Any) -> StarvlaPolicy:
    config = Config(**{"connect_deadline": 10.0, "cameras": VIEWS, "ping_every": 0, **settings})
    return starvla.build(config, robot, MonotonicClock(), 30.0)


@contextlib.contextmanager
def policy_at(url: str, **settings: Any) -> Iterator[StarvlaPolicy]:
    with contextlib.closing(built(url=url, **settings)) as policy:
        yield policy


@contextlib.contextmanager
def served(fault: Fault = NONE, **star: Any) -> Iterator[tuple[StarvlaServer, str]]:
    star = {"size": (24, 32), "views": tuple(VIEWS), **star}
    server = StarvlaServer(FRANKA, StarvlaBehaviour(fault=fault, **star))
    with contextlib.closing(server):
        yield server, str(server.start()["url"])


def answering(
    data: object, metadata: dict[str, Any] | None = None, asked: list[bytes] | None = None, **envelope: Any
) -> Handler:
    """Pings are answered; to what is inferred, an envelope around `data`, with what a test says otherwise."""

    def converse(connection: ServerConnection) -> None:
        connection.send(msgpack_arrays.pack(SAID if metadata is None else metadata))
        for request in connection:
            assert isinstance(request, bytes)
            message = msgpack_arrays.unpack(request)
            head = {
                "status": "ok",
                "ok": True,
                "type": "inference_result",
                "request_id": message["request_id"],
            }
            if message["type"] == "ping":
                connection.send(msgpack_arrays.pack(head | {"type": "ping"}))
                continue
            if asked is not None:
                asked.append(request)
            connection.send(
                data if isinstance(data, bytes) else msgpack_arrays.pack(head | {"data": data} | envelope)
            )

    return converse


def payload_of(
    shown: Observation | None = None, metadata: dict[str, Any] | None = None, **settings: Any
) -> Any:
    asked: list[bytes] = []
    with (
        serving(answering({"actions": ROWS}, metadata, asked)) as url,
        policy_at(url, **settings) as policy,
    ):
        policy.infer(shown or seen(FRANKA))
    return msgpack_arrays.unpack(asked[0])["payload"]


# The bytes that starVLA's own programs have written


def test_a_request_is_the_recorded_one_byte_for_byte() -> None:
    policy = built(unnorm_key="a", image_size=None)
    pixels = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
    pictures = {"cam_left_wrist": pixels, "cam_high": pixels + np.uint8(100)}
    qpos = np.array([0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.0], np.float32)
    payload = policy.payload(seen(FRANKA, qpos=qpos, pictures=pictures, prompt="pick"))
    payload["examples"][0]["state"] = payload["examples"][0]["state"][:, :7]  # the recorded robot has seven
    sent = msgpack_arrays.pack({"type": "infer", "request_id": "r1", "payload": payload})
    assert sent == (VECTORS / "starvla_infer_request.bin").read_bytes()


def test_the_recorded_answer_is_understood() -> None:
    reply = msgpack_arrays.unpack((VECTORS / "starvla_infer_reply.bin").read_bytes())
    policy = built(PIPER, cameras=["cam_high"])
    policy._width = 7
    policy._check_reply(reply, {"request_id": "r1"})
    chunk = policy._chunk(reply["data"], 1.0)
    np.testing.assert_array_equal(chunk.actions, np.arange(14, dtype=np.float32).reshape(2, 7) / 4)
    assert chunk.actions.dtype == np.float32


@pytest.mark.parametrize(
    ("frame", "says"),
    [
        (
            "85a6737461747573a56572726f72a26f6bc2a474797065a7756e6b6e6f776eaa726571756573745f6964a27032a56572726f7281"
            "a76d657373616765d920556e737570706f72746564206d65737361676520747970652027726573657427",
            "reports an error: Unsupported message type 'reset'",
        ),
        (
            "84a6737461747573a26f6ba26f6bc3a474797065a470696e67aa726571756573745f6964a27031",
            "request_id 'p1', asked was 'p2'",
        ),
    ],
)
def test_recorded_errors_and_pongs_are_told_apart(frame: str, says: str) -> None:
    with pytest.raises(PolicyError, match=says):
        built()._check_reply(msgpack_arrays.unpack(bytes.fromhex(frame)), {"request_id": "p2"})


def test_the_pong_answers_the_ping() -> None:
    pong = msgpack_arrays.unpack(
        bytes.fromhex("84a6737461747573a26f6ba26f6bc3a474797065a470696e67aa726571756573745f6964a27031")
    )
    built()._check_reply(pong, {"request_id": "p1"})
    assert msgpack_arrays.pack({"type": "ping", "request_id": "p1"}).hex() == (
        "82a474797065a470696e67aa726571756573745f6964a27031"
    )


# What is sent


def test_views_go_in_the_declared_order_and_the_state_has_a_row() -> None:
    payload = payload_of(metadata=SAID | {"training_obs_image_size": [24, 32]})
    (example,) = payload["examples"]
    assert [view.max() for view in example["image"]] == [1, 0]
    assert all(view.shape == (24, 32, 3) for view in example["image"])
    assert example["lang"] == "pick the block"
    assert example["state"].shape == (1, 8)
    assert example["state"].dtype == np.float32
    assert "unnorm_key" not in payload


@pytest.mark.parametrize(
    ("said", "settings", "size"),
    [
        (None, {}, (48, 64)),
        (224, {}, (224, 224)),
        ([3, 24, 32], {}, (24, 32)),
        ([24, 32, 3], {}, (24, 32)),
        (None, {"image_size": [24, 32]}, (24, 32)),
    ],
)
def test_views_have_the_size_of_the_training(
    said: Any, settings: dict[str, Any], size: tuple[int, int]
) -> None:
    payload = payload_of(metadata=SAID | {"training_obs_image_size": said}, **settings)
    assert payload["examples"][0]["image"][0].shape == (*size, 3)


def test_the_state_may_be_poses_or_nothing() -> None:
    pose = PoseFormat(orientation="6d", gripper=False)
    assert payload_of(observation_space="eef", observation_pose=pose)["examples"][0]["state"].shape == (1, 9)
    assert "state" not in payload_of(state=False)["examples"][0]


@pytest.mark.parametrize(
    ("metadata", "own", "key"),
    [
        ({"available_unnorm_keys": ["a", "b"], "default_unnorm_key": "b"}, None, "b"),
        ({"available_unnorm_keys": ["a", "b"], "default_unnorm_key": "b"}, "a", "a"),
        ({"available_unnorm_keys": ["a"], "default_unnorm_key": None}, None, "a"),
        ({}, "mine", "mine"),
    ],
)
def test_whose_statistics_are_meant_comes_from_the_metadata_or_the_deployment(
    metadata: dict[str, Any], own: str | None, key: str
) -> None:
    assert payload_of(metadata=SAID | metadata, unnorm_key=own)["unnorm_key"] == key


@pytest.mark.parametrize(
    ("metadata", "settings", "says"),
    [
        ({"available_unnorm_keys": ["a", "b"]}, {}, "statistics of a, b and no default; policy.unnorm_key"),
        ({"available_unnorm_keys": ["a"]}, {"unnorm_key": "c"}, "policy.unnorm_key = 'c', .*_keys = a"),
        (
            {"training_obs_image_size": 224},
            {"image_size": [24, 32]},
            r"size = 224, policy.image_size = \[24, 32\]",
        ),
    ],
)
def test_metadata_that_contradict_the_configuration_are_an_error(
    metadata: dict[str, Any], settings: dict[str, Any], says: str
) -> None:
    with (
        serving(answering({"actions": ROWS}, SAID | metadata)) as url,
        policy_at(url, **settings) as policy,
        pytest.raises(ContradictionError, match=says),
    ):
        policy.connect()


@pytest.mark.parametrize(
    ("metadata", "says"),
    [
        (
            {"action_space": "joint_position"},
            "env = None and action_space; expected env = 'starvla_policy_server'",
        ),
        ({}, "and nothing"),
        (SAID | {"training_obs_image_size": "big"}, "training_obs_image_size = 'big'"),
        (SAID | {"training_obs_image_size": 1}, "= 1; expected height and width, 8 to 4096 each"),
        (SAID | {"training_obs_image_size": [3, 224, 9000]}, "8 to 4096 each"),
    ],
)
def test_metadata_of_another_server_are_named(metadata: dict[str, Any], says: str) -> None:
    with (
        serving(answering({"actions": ROWS}, metadata)) as url,
        policy_at(url) as policy,
        pytest.raises(PolicyError, match=says),
    ):
        policy.connect()


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"cameras": []}, r"policy.cameras = \[\]; allowed: .* cam_high, cam_left_wrist"),
        ({"cameras": ["cam_high", "cam_high"]}, "each once of cam_high"),
        ({"cameras": ["cam_low"]}, "policy.cameras names cam_low"),
        (
            {"statistics": {"low": [0.0], "high": [1.0]}},
            "statistics has 1 numbers; the rows of this robot have 8",
        ),
    ],
)
def test_settings_that_do_not_fit_are_refused_before_anything_is_connected(
    settings: dict[str, Any], says: str
) -> None:
    with pytest.raises(ConfigurationError, match=says):
        built(**settings)


# What an answer means


@pytest.mark.parametrize("rows", [ROWS, ROWS[None], ROWS.astype(np.float32)])
def test_rows_come_with_a_batch_and_without(rows: np.ndarray) -> None:
    with serving(answering({"actions": rows})) as url, policy_at(url, action_rate=10.0) as policy:
        info = policy.connect()
        chunk = policy.infer(seen(FRANKA))
    assert (info.name, info.horizon, info.rate) == ("lab/model", 2, 10.0)
    assert (chunk.space, chunk.mode, chunk.rate) == ("joint", "absolute", 10.0)
    np.testing.assert_array_equal(chunk.actions, ROWS.astype(np.float32))


def test_normalised_rows_are_refused_without_statistics_and_undone_with_them() -> None:
    rows = np.array([[-1.0, 1, 0, 0.5, -2, 2, 0, 1]])
    statistics = {"low": [0.0] * 8, "high": [2.0] * 8, "mask": [True] * 7 + [False]}
    with serving(answering({"normalized_actions": rows[None]})) as url:
        with (
            policy_at(url) as policy,
            pytest.raises(
                PolicyError, match=r"the server returned normalized_actions; allowed: .*policy\.stat"
            ),
        ):
            policy.infer(seen(FRANKA))
        with policy_at(url, statistics=statistics) as policy:
            chunk = policy.infer(seen(FRANKA))
    np.testing.assert_allclose(chunk.actions, [[0, 2, 1, 1.5, 0, 2, 1, 1]])


@pytest.mark.parametrize(
    ("statistics", "says"),
    [
        ({"low": [0.0], "high": [1.0, 2.0]}, "low has 1 numbers, high 2"),
        ({"low": [0.0, 1.0], "high": [1.0, 1.0]}, r"low is not below high at \[1\]"),
    ],
)
def test_statistics_that_are_none_are_refused(statistics: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigurationError, match=says):
        built(statistics=statistics)


@pytest.mark.parametrize(
    ("data", "envelope", "says"),
    [
        ({"rows": 1}, {}, "neither 'actions' nor 'normalized_actions'; it has rows"),
        (None, {}, "data that are a NoneType"),
        ({"actions": ROWS[:, :7]}, {}, "rows of 7 numbers; this robot needs 8"),
        ({"actions": np.stack([ROWS, ROWS])}, {}, r"shape \[2, 2, 8\]"),
        ({"actions": ROWS}, {"request_id": "infer-99"}, "request_id 'infer-99', asked was 'infer-2'"),
        ({"actions": ROWS}, {"ok": False, "status": "error", "error": {"message": "no"}}, "an error: no"),
        ({"actions": ROWS}, {"ok": False, "status": "error", "error": "plain"}, "an error: plain"),
        (b"\xc1", {}, "not the StarVLA protocol"),
    ],
)
def test_an_answer_that_is_none_is_named(data: object, envelope: dict[str, Any], says: str) -> None:
    with (
        serving(answering(data, **envelope)) as url,
        policy_at(url) as policy,
        pytest.raises(PolicyError, match=says) as raised,
    ):
        policy.infer(seen(FRANKA))
    assert not isinstance(raised.value, PolicyLostError)


def test_conditioning_is_refused_because_the_protocol_has_no_place_for_it() -> None:
    with policy_at("ws://127.0.0.1:9") as policy, pytest.raises(PolicyError, match="no real-time chunking"):
        policy.infer(seen(FRANKA), Conditioning(np.zeros((2, 8), np.float32), 1, 0, 2))


# The conversation


@pytest.mark.parametrize("batched", [True, False])
def test_the_bundled_server_answers_with_rows_that_begin_where_the_robot_is(batched: bool) -> None:
    with served(batched=batched) as (server, url), policy_at(url) as policy:
        assert policy.connect().horizon == 16
        for value in (0.1, 0.4):
            chunk = policy.infer(seen(FRANKA, value))
            assert np.abs(chunk.actions[0] - np.clip(value, FRANKA.lower, FRANKA.upper)).max() < 0.05
        policy.reset()
        policy.infer(seen(FRANKA))
    assert server.seen[0]["unnorm_key"] == "stand_in"


def test_normalised_rows_of_the_bundled_server_are_its_plain_ones() -> None:
    with served() as (server, url), policy_at(url) as policy:
        plain = policy.infer(seen(FRANKA))
    statistics = {"low": server.low.tolist(), "high": server.high.tolist()}
    with served(Fault("normalized")) as (_, url), policy_at(url, statistics=statistics) as policy:
        np.testing.assert_allclose(policy.infer(seen(FRANKA)).actions, plain.actions, atol=1e-5)


def test_an_error_of_the_model_leaves_the_connection() -> None:
    with served(Fault("refused")) as (_, url), policy_at(url) as policy:
        for _ in range(2):
            with pytest.raises(PolicyError, match="reports an error: CUDA out of memory"):
                policy.infer(seen(FRANKA))
            assert policy._link.is_open


def test_another_number_of_views_is_the_servers_error() -> None:
    with (
        served() as (_, url),
        policy_at(url, cameras=["cam_high"]) as policy,
        pytest.raises(PolicyError, match="image is a list of 1, expected 2 views"),
    ):
        policy.infer(seen(FRANKA))


def test_pings_go_out_while_nobody_asks_until_it_is_closed() -> None:
    enough, pings = threading.Event(), []

    def converse(connection: ServerConnection) -> None:
        connection.send(msgpack_arrays.pack(SAID))
        for request in connection:
            message = msgpack_arrays.unpack(request)
            pings.append(message)
            connection.send(
                msgpack_arrays.pack({"status": "ok", "ok": True, "request_id": message["request_id"]})
            )
            if len(pings) == 3:
                enough.set()

    with serving(converse) as url, policy_at(url, ping_every=0.02) as policy:
        before = set(threading.enumerate())
        policy.connect()
        (thread,) = [one for one in set(threading.enumerate()) - before if one.name == "starvla-ping"]
        assert enough.wait(PATIENCE_S)
        policy.close()
        joined(thread)
    assert {message["type"] for message in pings} == {"ping"}
    assert len({message["request_id"] for message in pings}) == len(pings)


def test_no_ping_goes_out_where_a_deployment_says_0() -> None:
    assert Config().ping_every == 60.0
    asked = Config(**tomllib.loads("ping_every = 0"))
    with served() as (_, url), policy_at(url, ping_every=asked.ping_every) as policy:
        policy.connect()
        assert policy._silent.is_set(), "no thread sends pings"
    with pytest.raises(ValidationError, match="ping_every"):
        Config(ping_every=-1.0)


def test_a_ping_that_is_not_answered_drops_the_connection_and_the_next_request_opens_another(
    caplog: pytest.LogCaptureFixture,
) -> None:
    conversations: list[int] = []

    def converse(connection: ServerConnection) -> None:
        conversations.append(0)
        mute = len(conversations) == 1
        connection.send(msgpack_arrays.pack(SAID))
        for number, request in enumerate(connection):
            message = msgpack_arrays.unpack(request)
            head = {"status": "ok", "ok": True, "request_id": message["request_id"]}
            if not (mute and number):
                connection.send(msgpack_arrays.pack(head | {"data": {"actions": ROWS}}))

    with serving(converse) as url, policy_at(url, ping_every=0.02, inference_deadline=0.1) as policy:
        policy.connect()
        while policy._link.is_open:
            assert len(conversations) == 1
        assert policy.infer(seen(FRANKA)).actions.shape == (2, 8)
    assert "did not answer a ping" in caplog.text
