"""A station live in Foxglove: what it sends is read by programs that are not ours, and nobody can command."""

from __future__ import annotations

import argparse
import json
import struct
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq
from rosbags.typesys import Stores, get_typestore
from websockets.exceptions import InvalidStatus, NegotiationError
from websockets.sync.client import ClientConnection, connect

from runtime.clients.foxglove import server as bridge_server
from runtime.clients.foxglove.__main__ import TOKEN_FILE, serve
from runtime.clients.foxglove.server import PROTOCOL, FoxgloveServer
from runtime.clients.foxglove.topics import StationTopics, Topic
from runtime.clients.listener import get_or_create_token
from runtime.core.errors import ConfigurationError
from runtime.core.sentences import Pattern, within
from runtime.ipc.bus import Endpoints, Publisher
from tests.processes import PATIENCE_S, eventually

STORE = get_typestore(Stores.ROS2_HUMBLE)
FACTS = {"joint_names": ["left.joint0", "left.gripper", "right.joint0"], "cameras": ["cam.high"]}
_POLICY = Pattern("policy.of_this_test", "the policy at {url} is silent")
_CONTROL = Pattern("control.of_this_test", "{joint} was limited")


def snapshot(**more: Any) -> dict[str, Any]:
    return {"facts": FACTS, "state": "running", "reason": "", "allowed": [], "sentences": {}, **more}


def joints(**more: Any) -> dict[str, Any]:
    vectors = {"measured": [1.0, 0.5, 2.0], "commanded": [1.5, 0.5, 2.5], "planned": [np.nan] * 3}
    return {name: np.array(vector, np.float32) for name, vector in vectors.items()} | {
        "engaged": True,
        **more,
    }


class Station:
    """What a station publishes, at the test's command."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True)
        context: zmq.Context[Any] = zmq.Context.instance()
        self.state = Publisher(context, folder, "state", 64)
        self.cameras = Publisher(context, folder, "cameras", 16)
        Endpoints(folder).write("coordinator", {"state": self.state.endpoint})
        Endpoints(folder).write("media", {"cameras": self.cameras.endpoint})

    def has(self, *streams: str) -> bool:
        for publisher in (self.state, self.cameras):
            publisher.poll_subscriptions()
        topics = self.state.topics | self.cameras.topics
        return all(any(stream.startswith(topic) for topic in topics) for stream in streams)

    def close(self) -> None:
        self.state.close()
        self.cameras.close()


@pytest.fixture
def station(tmp_path: Path) -> Iterator[Station]:
    made = Station(tmp_path / "stations" / "bench")
    yield made
    made.close()


@pytest.fixture
def address(station: Station, tmp_path: Path) -> Iterator[str]:
    options = argparse.Namespace(
        host="127.0.0.1", port=0, certificate=None, key=None, origin=["https://lab.example.org"]
    )
    ended, found = threading.Event(), []
    bridge = threading.Thread(
        target=serve, args=(tmp_path / "stations" / "bench", options, ended.is_set, found.append)
    )
    bridge.start()
    yield eventually(lambda: found, "the address")[0]
    ended.set()
    bridge.join(PATIENCE_S)
    assert not bridge.is_alive()


def reached(address: str, **more: Any) -> ClientConnection:
    return connect(address, subprotocols=[PROTOCOL], max_size=None, **more)  # type: ignore[list-item]


def told(client: ClientConnection, operation: str) -> dict[str, Any]:
    while True:
        message = client.recv(PATIENCE_S)
        if isinstance(message, str) and (found := json.loads(message))["op"] == operation:
            return dict(found)


def frame(client: ClientConnection) -> tuple[int, int, bytes]:
    while not isinstance(message := client.recv(PATIENCE_S), bytes):
        pass
    opcode, subscription, stamp = struct.unpack_from("<BIQ", message)
    assert opcode == 1
    return subscription, stamp, message[13:]


def subscribed(client: ClientConnection, station: Station, *topics: str) -> dict[str, dict[str, Any]]:
    """Publish states until the topics are advertised, subscribe to them, and return their channels."""
    eventually(lambda: station.has("state"), "the bridge reads states")
    station.state.publish("state", snapshot())
    channels = {row["topic"]: row for row in told(client, "advertise")["channels"]}
    rows = [{"id": 100 + number, "channelId": channels[topic]["id"]} for number, topic in enumerate(topics)]
    client.send(json.dumps({"op": "subscribe", "subscriptions": rows}))
    return channels


def test_joints_cameras_and_states_are_read_by_others(station: Station, address: str) -> None:
    with reached(address) as client:
        assert told(client, "serverInfo")["capabilities"] == []
        names = (
            "/left/joint_states",
            "/right/joint_commands",
            "/left/joint_planned",
            "/cameras/cam_high/compressed",
        )
        channels = subscribed(client, station, *names, "/eva/state")
        assert channels["/left/joint_states"]["schemaName"] == "sensor_msgs/msg/JointState"
        assert channels["/left/joint_states"]["encoding"] == "cdr"
        eventually(lambda: station.has("joints", "camera/cam.high"), "only what is subscribed is read")
        assert not station.has("event")
        station.state.publish("joints", joints())
        station.cameras.publish("camera/cam.high", b"\xff\xd8jpeg")
        station.state.publish("state", snapshot(reason="a text of a library"))
        found: dict[int, Any] = {}
        kinds = ("JointState", "JointState", "JointState", "CompressedImage", "String")
        while set(found) < {100, 101, 103, 104}:
            subscription, stamp, payload = frame(client)
            kind = kinds[subscription - 100]
            package = "std_msgs" if kind == "String" else "sensor_msgs"
            found[subscription] = STORE.deserialize_cdr(payload, f"{package}/msg/{kind}")
            if kind != "String":
                header = found[subscription].header.stamp
                assert header.sec * 10**9 + header.nanosec == stamp
        assert (found[100].name, found[100].position.tolist()) == (["joint0", "gripper"], [1.0, 0.5])
        assert (found[101].name, found[101].position.tolist()) == (["joint0"], [2.5])
        assert (found[103].format, bytes(found[103].data)) == (
            "jpeg",
            b"\xff\xd8jpeg",
        )
        assert json.loads(found[104].data)["reason"] in ("", "the console and the station's log say why")


def test_every_event_is_sent_and_nothing_that_a_blind_plan_hides(station: Station, address: str) -> None:
    with reached(address) as client:
        subscribed(client, station, "/eva/events")
        eventually(lambda: station.has("event"), "the bridge reads events")
        events = [
            ("limited", _CONTROL(joint="joint0")),
            ("truth", "the simulated bench says: success"),
            ("policy_lost", _POLICY(url="ws://gpu-3:8000")),
            ("limited", _CONTROL(joint="joint1")),
        ]
        for kind, text in events:
            facts = within({"text": text}).get("text", {})
            row = {"kind": kind, "text": str(text), "step": 3, "time": 1.5, **facts}
            station.state.publish("event", row)
        payloads = [frame(client)[2] for _ in range(3)]
    assert [b"joint0" in payloads[0], b"joint1" in payloads[2]] == [True, True]
    assert not any(b"gpu-3" in payload or b"success" in payload for payload in payloads)


def test_nobody_can_command_and_what_cannot_be_read_is_said(station: Station, address: str) -> None:
    with reached(address) as client:
        for message in (
            json.dumps({"op": "advertise", "channels": []}),
            b"\x01\x00",
            "[1]",
            '{"op": "subscribe"}',
        ):
            client.send(message)
            assert told(client, "status")["level"] == 2


def test_a_client_needs_the_token_the_protocol_and_an_origin_that_is_allowed(
    station: Station, address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for given, more, status in (
        (address.partition("?")[0], {}, 401),
        (address + "x", {}, 401),
        (address, {"origin": "https://evil.example.org"}, 403),
    ):
        with pytest.raises(InvalidStatus) as refused:
            reached(given, **more)
        assert refused.value.response.status_code == status
    with pytest.raises((InvalidStatus, NegotiationError)):
        connect(address)
    with reached(address, origin="https://lab.example.org") as client:
        assert told(client, "serverInfo")["name"] == "bench"
        monkeypatch.setattr(bridge_server, "_MOST_CLIENTS", 1)
        with pytest.raises(InvalidStatus) as full:
            reached(address)
        assert full.value.response.status_code == 503


def test_a_slow_client_gets_the_newest_and_keeps_nobody(tmp_path: Path) -> None:
    server = FoxgloveServer("bench", "secret", ())
    port = server.open("127.0.0.1", 0)
    topic = StationTopics(FACTS).topics[-1]
    server.advertise([topic, Topic("/other", "std_msgs/String", "state")])
    try:
        with reached(f"ws://127.0.0.1:{port}/?token=secret", max_queue=1) as slow:
            channel = told(slow, "advertise")["channels"][0]["id"]
            slow.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": channel}]}))
            eventually(lambda: topic.name in server.wanted, "the subscription")
            for number in range(300):
                server.publish(topic.name, struct.pack("<I", number) + bytes(100_000), number)
            (client,) = server._clients
            assert sum(map(len, client._waiting.values())) <= 1
            stamps = [frame(slow)[1]]
            while stamps[-1] < 299:
                stamps.append(frame(slow)[1])
            assert stamps == sorted(stamps)
            assert len(stamps) < 300
        eventually(lambda: not server.wanted, "who has left wants nothing")
    finally:
        server.close()


def test_another_robot_has_other_topics(tmp_path: Path) -> None:
    server = FoxgloveServer("bench", "secret", ())
    port = server.open("127.0.0.1", 0)
    try:
        server.advertise(StationTopics(FACTS).topics)
        with reached(f"ws://127.0.0.1:{port}/?token=secret") as client:
            before = {row["id"] for row in told(client, "advertise")["channels"]}
            server.advertise(StationTopics({**FACTS, "cameras": []}).topics)
            assert set(told(client, "unadvertise")["channelIds"]) == before
            assert not before & {row["id"] for row in told(client, "advertise")["channels"]}
    finally:
        server.close()


def test_beyond_this_machine_it_needs_a_certificate_and_the_token_is_for_this_account_alone(
    tmp_path: Path,
) -> None:
    options = argparse.Namespace(host="0.0.0.0", port=0, certificate=None, key=None, origin=[])
    with pytest.raises(ConfigurationError, match="beyond this machine it needs --certificate and --key"):
        serve(tmp_path / "bench", options, lambda: True)
    assert get_or_create_token(tmp_path / "bench", TOKEN_FILE) == get_or_create_token(
        tmp_path / "bench", TOKEN_FILE
    )
    assert (tmp_path / "bench" / "foxglove.token").stat().st_mode & 0o777 == 0o600
