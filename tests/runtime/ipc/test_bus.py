import errno
import os
import shutil
import time
from pathlib import Path

import pytest
import zmq

from runtime.core.errors import TransportError
from runtime.core.msgpack_arrays import pack
from runtime.ipc import bus
from runtime.ipc.bus import (
    CAMERA_HIGH_WATER,
    STREAM_HIGH_WATER,
    CommandClient,
    CommandServer,
    Endpoints,
    EventLog,
    Publisher,
    Subscriber,
)
from runtime.ipc.messages import Ack, Command, Event, decode, encode
from tests.processes import PATIENCE_MS, PATIENCE_S, eventually

PACE_S = 0.002  # between bursts: ZMQ looks only once a millisecond at what a reader has taken


@pytest.fixture
def context():
    made = zmq.Context()
    yield made
    made.destroy(linger=0)


@pytest.fixture
def server(context, tmp_path):
    return CommandServer(context, tmp_path, "commands")


@pytest.fixture
def raw(context, server):
    """A client that sends whatever it likes."""
    requests = context.socket(zmq.DEALER)
    requests.connect(server.endpoint)
    return requests


def next_command(server):
    assert server.socket.poll(PATIENCE_MS)
    return server.receive()


def answer_to(raw):
    assert raw.poll(PATIENCE_MS)
    return decode(raw.recv_multipart()[-1])


# --- commands ----------------------------------------------------------------------------------------------


def test_without_a_command_the_server_does_not_wait(server):
    assert server.receive() is None


def test_a_command_is_answered_to_who_sent_it(context, server, raw):
    other = context.socket(zmq.DEALER)
    other.connect(server.endpoint)
    raw.send(encode(Command("mine", "run")))
    other.send(encode(Command("theirs", "stop")))
    for _ in range(2):
        address, command = next_command(server)
        server.answer(address, Ack(command.uuid, "accepted"))
    assert answer_to(raw).uuid == "mine"
    assert answer_to(other).uuid == "theirs"


def test_a_request_socket_is_served_too(context, server):
    requests = context.socket(zmq.REQ)
    requests.connect(server.endpoint)
    requests.send(encode(Command("u", "run")))
    address, command = next_command(server)
    server.answer(address, Ack(command.uuid, "accepted"))
    assert answer_to(requests) == Ack("u", "accepted")


GARBAGE = {
    "nothing": b"",
    "no msgpack": b"\xc1\xff\x00",
    "no message": pack([1, 2]),
    "an unhashable type": pack({"type": ["Command"]}),
    "an unhashable uuid": pack({"type": "Command", "uuid": [1], "kind": "run"}),
    "no map of arguments": pack({"type": "Command", "uuid": "u", "kind": "run", "args": None}),
    "a word for a number": pack({"type": "Command", "uuid": "u", "kind": "run", "epoch": "x"}),
    "another message": encode(Event("k", "t", 0.0)),
}


@pytest.mark.parametrize("payload", GARBAGE.values(), ids=GARBAGE.keys())
def test_garbage_is_answered_with_a_reason_and_the_next_command_is_served(server, raw, payload):
    raw.send(payload)
    raw.send(encode(Command("u", "run")))
    assert server.socket.poll(PATIENCE_MS)
    received = server.receive() or next_command(server)
    refusal = answer_to(raw)
    assert (refusal.uuid, refusal.status) == ("", "refused")
    assert refusal.reason
    assert received[1] == Command("u", "run")


def test_an_answer_to_a_client_that_is_gone_is_lost_without_harm(context, server, raw):
    raw.send(encode(Command("u", "run")))
    address, command = next_command(server)
    raw.close(linger=0)
    for _ in range(2000):
        server.answer(address, Ack(command.uuid, "accepted"))
    requests = context.socket(zmq.DEALER)
    requests.connect(server.endpoint)
    requests.send(encode(Command("v", "stop")))
    assert next_command(server)[1].uuid == "v"


def test_a_client_gets_its_answer(context, server):
    client = CommandClient(context, server.endpoint)
    raw_send = client._socket.send
    raw_send(encode(Command("u", "run")))  # a first one under way: its answer is not the second one's
    address, _ = next_command(server)
    server.answer(address, Ack("u", "refused", "the first"))
    server.answer(address, Ack("v", "accepted", "the second"))
    assert client.request(Command("v", "stop"), 2.0) == Ack("v", "accepted", "the second")


def test_without_an_answer_the_outcome_is_unknown(context, server):
    client = CommandClient(context, server.endpoint)
    with pytest.raises(TransportError, match=r"no answer to run within 0.01 s: outcome unknown"):
        client.request(Command("u", "run"), 0.01)


@pytest.mark.parametrize("late", [Ack("first", "accepted"), Ack("", "refused", "unreadable")])
def test_a_late_answer_is_never_taken_for_that_of_the_next_command(context, server, late):
    client = CommandClient(context, server.endpoint)
    with pytest.raises(TransportError):
        client.request(Command("first", "run"), 0.03)
    address, command = next_command(server)
    assert command.uuid == "first"
    server.answer(address, late)
    with pytest.raises(TransportError, match="no answer to stop"):
        client.request(Command("second", "stop"), 0.03)
    address, command = next_command(server)
    assert command.uuid == "second"


def test_a_command_nobody_took_in_time_is_not_delivered_when_the_runtime_comes_up(context, server):
    server.close()
    client = CommandClient(context, server.endpoint)
    with pytest.raises(TransportError):
        client.request(Command("old", "stop"), 0.02)
    again = context.socket(zmq.ROUTER)
    again.bind(server.endpoint)
    client._socket.send(encode(Command("new", "stop")))
    assert again.poll(PATIENCE_MS)
    assert decode(again.recv_multipart()[-1]).uuid == "new"
    assert not again.poll(0)


def test_a_socket_that_somebody_removed_is_listened_at_anew(context, server, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(bus, "_LOOK_S", 0.0)
    before = server.endpoint
    early = context.socket(zmq.DEALER)
    early.connect(before)
    early.send(encode(Command("early", "run")))
    address, _ = next_command(server)
    assert not server.rebind_if_unreachable()
    shutil.rmtree(os.environ["XDG_RUNTIME_DIR"] + "/eva-web")  # as with the last logout of the account
    assert server.rebind_if_unreachable()
    assert server.endpoint != before
    assert f"it is {server.endpoint.removeprefix('ipc://')} now" in caplog.text
    server.answer(address, Ack("early", "accepted"))
    assert answer_to(early).uuid == "early", "who was connected stays so"
    late = context.socket(zmq.DEALER)
    late.connect(server.endpoint)
    late.send(encode(Command("late", "run")))
    assert next_command(server)[1].uuid == "late"


# --- streams -----------------------------------------------------------------------------------------------


def connected(publisher, subscriber, stream):
    """Publish until the subscription has arrived."""
    for _ in range(200):
        publisher.publish(stream, {"hello": True})
        if subscriber.receive(0.01):
            break
    else:
        pytest.fail("the subscription did not arrive")
    while subscriber.receive(0.01):
        pass


@pytest.fixture
def publisher(context, tmp_path):
    return Publisher(context, tmp_path, "state", STREAM_HIGH_WATER)


def test_a_subscriber_gets_what_it_asked_for_by_prefix(context, publisher):
    subscriber = Subscriber(context, publisher.endpoint, "state", "camera/")
    connected(publisher, subscriber, "state")
    publisher.publish("joints", {"step": 1})
    publisher.publish("camera/high", b"jpeg")
    publisher.publish("state", {"sequence": 2})
    seen = {}
    while content := subscriber.receive(0.2):
        seen |= content
        if len(seen) == 2:
            break
    assert seen == {"camera/high": b"jpeg", "state": {"sequence": 2}}


def test_a_publisher_knows_what_is_read(context, publisher):
    def heard(stream, wanted):
        begun = []

        def asked():
            begun.extend(publisher.poll_subscriptions())
            return publisher.has_subscriber(stream) is wanted

        eventually(asked, f"{stream} is wanted: {wanted}")
        return begun

    assert not publisher.has_subscriber("state")
    subscriber = Subscriber(context, publisher.endpoint, "camera/", "state")
    assert heard("state", True) + publisher.poll_subscriptions() in (
        ["camera/", "state"],
        ["state", "camera/"],
    )
    assert publisher.has_subscriber("camera/high")
    assert not publisher.has_subscriber("joints")
    subscriber.close()
    assert heard("state", False) == []


def test_what_is_no_subscription_is_passed_over(context, publisher):
    stranger = context.socket(zmq.XSUB)
    stranger.connect(publisher.endpoint)
    stranger.send(b"\x07what is this")
    stranger.send(b"\x01state")
    eventually(
        lambda: publisher.poll_subscriptions() == ["state"] or publisher.has_subscriber("state"),
        "it is heard",
    )
    assert publisher.topics == {"state"}
    stranger.close(linger=0)


def test_a_subscriber_without_news_gets_nothing(context, publisher):
    subscriber = Subscriber(context, publisher.endpoint, "state")
    assert subscriber.receive(0.01) == {}


def test_a_slow_subscriber_gets_the_newest_each_time_it_looks(context, publisher):
    subscriber = Subscriber(context, publisher.endpoint, "state")
    connected(publisher, subscriber, "state")
    number = 0
    for _ in range(5):
        time.sleep(PACE_S)
        for _ in range(20):
            number += 1
            publisher.publish("state", {"number": number})
        newest = 0
        while content := subscriber.receive(0.01):
            assert content["state"]["number"] > newest
            newest = content["state"]["number"]
        assert newest == number


def test_the_newest_is_not_hidden_behind_the_old(context, publisher):
    # One look per burst: were each look to find only a part of it, it would fall behind for ever.
    subscriber = Subscriber(context, publisher.endpoint, "state")
    connected(publisher, subscriber, "state")
    newest, last = 0, 30 * 20
    for number in range(1, last + 1):
        publisher.publish("state", {"number": number})
        if number % 20 == 0:
            time.sleep(PACE_S)
            newest = subscriber.receive(0.5)["state"]["number"]
    looks = 0
    while newest < last:
        newest = subscriber.receive(0.5)["state"]["number"]
        looks += 1
    assert looks <= 10


def test_who_was_away_does_not_get_what_has_piled_up_meanwhile(context, publisher, monkeypatch):
    subscriber = Subscriber(context, publisher.endpoint, "state")
    connected(publisher, subscriber, "state")
    for _ in range(5000):
        publisher.publish("state", {"old": True, "filling": bytes(2000)})
    monkeypatch.setattr(bus, "_AWAY_S", -1.0)
    assert subscriber.receive(0.0) == {}
    monkeypatch.undo()
    for _ in range(200):
        publisher.publish("state", {"new": True})
        if content := subscriber.receive(0.01):
            break
    assert content == {"state": {"new": True}}


def test_three_cameras_at_once_all_arrive(context, tmp_path):
    publisher = Publisher(context, tmp_path, "cameras", CAMERA_HIGH_WATER)
    subscriber = Subscriber(context, publisher.endpoint, "camera/")
    connected(publisher, subscriber, "camera/0")
    for _ in range(10):
        time.sleep(PACE_S)
        for camera in range(3):
            publisher.publish(f"camera/{camera}", bytes(20_000))
        seen = {}
        while len(seen) < 3 and (content := subscriber.receive(0.5)):
            seen |= content
        assert set(seen) == {"camera/0", "camera/1", "camera/2"}


def test_a_publisher_never_waits_for_a_reader_that_has_stopped(context, publisher):
    subscriber = Subscriber(context, publisher.endpoint, "camera/")
    connected(publisher, subscriber, "camera/high")
    for _ in range(500):
        publisher.publish("camera/high", bytes(100_000))
    assert subscriber.receive(2.0) == {"camera/high": bytes(100_000)}


# --- where the sockets are ---------------------------------------------------------------------------------


def test_endpoints_are_found_in_the_stations_folder(tmp_path):
    Endpoints(tmp_path / "bench-1").write("coordinator", {"commands": "tcp://127.0.0.1:1"})
    Endpoints(tmp_path / "bench-1").write("coordinator", {"commands": "tcp://127.0.0.1:2"})
    found = Endpoints(tmp_path / "bench-1").read("coordinator")
    assert found["commands"] == "tcp://127.0.0.1:2"
    assert isinstance(found["pid"], int)


def test_a_station_that_does_not_run_is_named_with_those_that_do(tmp_path):
    Endpoints(tmp_path / "bench-1").write("coordinator", {})
    with pytest.raises(TransportError, match=r"station 'bench-2' is not running here.*once run: bench-1\)"):
        Endpoints(tmp_path / "bench-2").read("coordinator")


def test_a_damaged_file_is_a_station_that_does_not_run(tmp_path):
    endpoints = Endpoints(tmp_path / "bench-1")
    endpoints.write("coordinator", {})
    (tmp_path / "bench-1" / "endpoints" / "coordinator.json").write_text("{", "utf-8")
    with pytest.raises(TransportError, match="bench-1' is not running here"):
        endpoints.read("coordinator")


def test_what_a_former_family_left_can_be_cleared(tmp_path):
    endpoints = Endpoints(tmp_path / "bench-1")
    endpoints.clear()
    endpoints.write("coordinator", {})
    endpoints.clear()
    with pytest.raises(TransportError):
        endpoints.read("coordinator")


@pytest.fixture
def refusing(monkeypatch):
    """A disk that takes nothing until the test says so."""
    disk = {"full": True}
    write = Path.write_text

    def written(path, *arguments):
        if disk["full"]:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(path, *arguments)

    monkeypatch.setattr(Path, "write_text", written)
    monkeypatch.setattr("runtime.ipc.endpoints.RETRY_S", 0.01)
    return disk


def test_endpoints_that_the_disk_refuses_are_said_and_come_when_it_takes_them(tmp_path, refusing, caplog):
    endpoints = Endpoints(tmp_path / "bench-1")
    assert endpoints.write("media", {"cameras": "tcp://127.0.0.1:1"}) is False
    assert endpoints.write("media", {"cameras": "tcp://127.0.0.1:2"}) is False
    assert "cannot find the process media until the disk takes its file" in caplog.text
    with pytest.raises(TransportError):
        endpoints.read("media")
    refusing["full"] = False
    deadline = time.monotonic() + PATIENCE_S
    while not list(tmp_path.glob("bench-1/endpoints/*.json")):
        assert time.monotonic() < deadline
    assert endpoints.read("media")["cameras"] == "tcp://127.0.0.1:2"
    assert endpoints.write("media", {"cameras": "tcp://127.0.0.1:3"}) is True
    assert endpoints.read("media")["cameras"] == "tcp://127.0.0.1:3"


def test_endpoints_that_are_cleared_do_not_come_later(tmp_path, refusing):
    endpoints = Endpoints(tmp_path / "bench-1")
    endpoints.write("media", {})
    endpoints.clear()
    refusing["full"] = False
    assert endpoints.write("coordinator", {}) is True
    assert [path.name for path in tmp_path.glob("bench-1/endpoints/*.json")] == ["coordinator.json"]


# --- events ------------------------------------------------------------------------------------------------


def test_events_are_numbered_from_one_without_gaps():
    log = EventLog()
    rows = [log.append(Event("k", f"event {n}", float(n), n, {"n": n})) for n in range(3)]
    assert [row["number"] for row in rows] == [1, 2, 3]
    assert log.newest == 3
    assert [row["text"] for row in log.since(1)] == ["event 1", "event 2"]
    assert log.since(3) == []
    assert (rows[2]["kind"], rows[2]["time"], rows[2]["step"], rows[2]["data"]) == ("k", 2.0, 2, {"n": 2})


def test_old_events_are_forgotten_but_their_numbers_are_not_used_again(monkeypatch):
    monkeypatch.setattr(bus, "EVENTS_KEPT", 3)
    log = EventLog()
    for n in range(5):
        log.append(Event("k", f"event {n}", float(n)))
    assert [row["number"] for row in log.since(0)] == [3, 4, 5]
