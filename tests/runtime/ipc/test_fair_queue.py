"""What one turn looks into: all stops, a bounded part of the rest, and everybody's share of it."""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack  # type: ignore[import-untyped]
import pytest
import zmq

from runtime.core.msgpack_arrays import pack
from runtime.ipc import bus
from runtime.ipc.bus import MAX_MESSAGES_PER_TURN, MAX_WAITING_PER_CONNECTION, CommandServer
from runtime.ipc.estop_requests import kind_of
from runtime.ipc.fair_queue import FairQueue
from runtime.ipc.messages import Ack, Command, decode, encode
from tests.processes import PATIENCE_MS, PATIENCE_S

SHARE = 8
STOPS = ("stop", "halt")


class Bench:
    """A server, its turns, and clients that ask without waiting for answers."""

    def __init__(self, folder: Path) -> None:
        self.context: zmq.Context[Any] = zmq.Context()
        self.server = CommandServer(self.context, folder, "commands")
        self.turns = FairQueue(self.server, STOPS, SHARE)

    def client(self) -> zmq.Socket[bytes]:
        made: zmq.Socket[bytes] = self.context.socket(zmq.DEALER)
        made.set_hwm(100_000)
        made.linger = 0
        made.connect(self.server.endpoint)
        return made

    def take(self) -> tuple[list[str], list[str]]:
        """The uuids of one turn; each is answered."""
        self.server.socket.poll(0 if self.turns.has_waiting else 2000)
        urgent, others = self.turns.take_turn()
        for call, command in (*urgent, *others):
            self.server.answer(call, Ack(command.uuid, "done"))
        return [command.uuid for _, command in urgent], [command.uuid for _, command in others]

    def turns_until(self, uuid: str) -> int:
        for turn in range(1, 10_000):
            if uuid in self.take()[0]:
                return turn
        raise AssertionError(f"{uuid} was never looked into")

    def close(self) -> None:
        self.context.destroy(linger=0)


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    made = Bench(tmp_path)
    yield made
    made.close()


def said(kind: str, uuid: str = "u", **arguments: Any) -> bytes:
    return encode(Command(uuid, kind, arguments))


def answers(client: zmq.Socket[bytes]) -> list[Ack]:
    found = []
    while client.poll(200):
        message = decode(client.recv())
        assert isinstance(message, Ack)
        found.append(message)
    return found


# --- a command's kind, before anything else of it ----------------------------------------------------------


def test_the_kind_is_read_without_the_arguments() -> None:
    whole = said("halt", why="x" * 100_000)
    assert kind_of(whole) == kind_of(whole[:60]) == "halt"
    assert kind_of(pack({"args": {}, "uuid": "u" * 600, "type": "Command", "kind": "stop"})) == "stop"


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"\xc1",
        pack([1]),
        pack(3),
        pack({}),
        pack({"type": "Command", "uuid": "u", "kind": 7}),
        b"\xdf\xff\xff\xff\xff",
        b"\x91" * 600,
    ],
)
def test_what_says_no_kind_has_none(payload: bytes) -> None:
    assert kind_of(payload) == ""


def test_no_bytes_end_who_looks_for_a_kind() -> None:
    drawn = random.Random(4)
    whole = said("stop", why=[1, {"a": 2.0}])
    for _ in range(3000):
        mutant = bytearray(whole)
        for _ in range(drawn.randint(1, 8)):
            mutant[drawn.randrange(len(mutant))] = drawn.randrange(256)
        assert isinstance(kind_of(bytes(mutant[: drawn.randint(0, len(mutant))])), str)


# --- turns -------------------------------------------------------------------------------------------------


def test_a_stop_behind_ten_thousand_questions_of_others_is_seen_within_a_few_turns(bench: Bench) -> None:
    flood = [bench.client() for _ in range(10)]
    for number in range(1000):
        for client in flood:
            client.send(said("status", str(number)))
    bench.take()
    client = bench.client()
    client.send(said("stop", "mine"))
    assert bench.turns_until("mine") < 10_000 / SHARE


def test_a_stop_behind_ten_thousand_questions_of_ones_own_is_seen_too(bench: Bench) -> None:
    client = bench.client()
    for number in range(10_000):
        client.send(said("status", str(number)))
    client.send(said("halt", "mine"))
    assert bench.turns_until("mine") < 10_000 / MAX_WAITING_PER_CONNECTION


def test_a_turn_is_bounded_however_much_has_come(bench: Bench) -> None:
    client = bench.client()
    for number in range(3 * MAX_MESSAGES_PER_TURN):
        client.send(said("status", str(number)))
    for _ in range(3):
        urgent, others = bench.take()
        assert (len(urgent), len(others) <= SHARE) == (0, True)
        assert sum(map(len, bench.turns._waiting.values())) <= MAX_WAITING_PER_CONNECTION


def test_what_is_too_much_is_refused_unread_and_says_so(bench: Bench) -> None:
    client = bench.client()
    for number in range(200):
        client.send(said("status", str(number)))
    done: list[str] = []
    found: list[Ack] = []
    for _ in range(60):
        done += bench.take()[1]
        found += answers(client)
        if len(found) == 200:
            break
    assert len(found) == 200
    refused = [ack for ack in found if ack.status == "refused"]
    assert {(ack.uuid, ack.reason) for ack in refused} == {
        ("", "more than 32 requests at once over one connection: wait for answers; stops are obeyed")
    }
    assert [ack.uuid for ack in found if ack.status == "done"] == done


def test_each_connection_has_its_turn(bench: Bench) -> None:
    greedy, modest = bench.client(), bench.client()
    for number in range(MAX_WAITING_PER_CONNECTION):
        greedy.send(said("status", str(number)))
    bench.turns._share = 0
    while sum(map(len, bench.turns._waiting.values())) < MAX_WAITING_PER_CONNECTION:
        assert bench.server.socket.poll(PATIENCE_MS)
        bench.turns.take_turn()
    bench.turns._share = SHARE
    assert len(bench.take()[1]) == SHARE
    modest.send(said("status", "modest"))
    assert bench.server.socket.poll(PATIENCE_MS)
    assert "modest" in bench.take()[1] + bench.take()[1]


def test_a_stop_in_another_order_of_fields_is_a_stop(bench: Bench) -> None:
    client = bench.client()
    client.send(pack({"kind": "stop", "args": {"x": "y" * 600}, "uuid": "mine", "type": "Command"}))
    assert bench.take() == (["mine"], [])


def test_who_says_stop_first_and_then_something_else_has_no_stop(bench: Bench) -> None:
    client = bench.client()
    honest = said("stop", "mine")
    twice = bytes([honest[0] + 1]) + honest[1:] + msgpack.packb("kind") + msgpack.packb("run")
    client.send(twice)
    assert bench.take() == ([], ["mine"])


@pytest.mark.parametrize("noise", [b"\xc1" * (200 << 10), msgpack.packb(["x"] * (100 << 10))])
def test_no_more_of_a_flood_of_long_garbage_is_read_in_a_turn_than_its_share(
    bench: Bench, noise: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[int] = []
    monkeypatch.setattr(bus, "decode", lambda payload: read.append(len(payload)) or decode(payload))
    noisy, client = bench.client(), bench.client()
    for _ in range(200):
        noisy.send(noise)
    client.send(said("estop", "mine"))
    turns = bench.turns_until("mine")
    assert turns < 200 / SHARE
    assert len(read) <= turns * SHARE


def test_what_is_too_long_for_a_server_is_refused_unread_but_for_a_press(bench: Bench) -> None:
    bench.turns = FairQueue(bench.server, (), SHARE, 100)
    client = bench.client()
    client.send(said("status", more="x" * 200))
    client.send(said("estop", "mine", why="x" * 200_000))
    assert bench.turns_until("mine") <= 2  # the first may come before it
    assert "allowed here: 100" in answers(client)[0].reason


def test_garbage_is_answered_within_its_share_and_keeps_no_stop_back(bench: Bench) -> None:
    noisy, client = bench.client(), bench.client()
    for _ in range(1500):
        noisy.send(b"\xc1 no message")
    client.send(said("stop", "mine"))
    assert bench.turns_until("mine") < 1500 / SHARE


def test_who_reads_no_answers_costs_no_memory(bench: Bench) -> None:
    deaf, client = bench.client(), bench.client()
    for number in range(5000):
        deaf.send(said("status", str(number)))
    client.send(said("stop", "mine"))
    assert bench.turns_until("mine") < 5000 / SHARE
    assert [ack.uuid for ack in answers(client)] == ["mine"]


def test_more_half_open_peers_than_the_usual_limit_of_files_keep_nobody_out(bench: Bench) -> None:
    import socket

    path = bench.server.endpoint.removeprefix("ipc://")
    peers = []
    try:
        for number in range(1200):
            peer = socket.socket(socket.AF_UNIX)
            peer.connect(path)
            if number % 3:
                peer.sendall(b"\xff\0\0\0\0\0\0\0\1\x7f"[: number % 11])
            peers.append(peer)
        client = bench.client()
        client.send(said("stop", "mine"))
        assert bench.server.socket.poll(PATIENCE_MS)
        assert bench.turns_until("mine") == 1
        assert peers[0].recv(64)  # ZMQ's greeting
        peers[0].settimeout(PATIENCE_S)
        assert peers[0].recv(64) == b"", "it is let go"
    finally:
        for peer in peers:
            peer.close()


def test_a_message_larger_than_any_of_ours_ends_its_connection_alone(bench: Bench) -> None:
    large, client = bench.client(), bench.client()
    large.send(said("status", "large", more="x" * (300 << 10)))
    client.send(said("status", "mine"))
    assert bench.take() == ([], ["mine"])
