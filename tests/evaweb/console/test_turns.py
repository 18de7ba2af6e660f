"""What many ask at once is done in turns, and below the messages a socket says no more than it may."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace

import pytest
from daphne.ws_protocol import WebSocketProtocol
from twisted.internet.abstract import FileDescriptor

from evaweb.console.flow_control import AT_ONCE, MessageQuota, TurnScheduler
from evaweb.console.reading import AHEAD, STALLED_S, until_read
from evaweb.console.websocket_limits import (
    _MOST_PARTS,
    PING,
    LimitedWebSocket,
    unsent,
)


@pytest.fixture
def loop():
    """What is planned for the next turn; `turn` is that turn."""
    planned = []

    def turn():
        due, planned[:] = list(planned), []
        for work in due:
            work()

    return SimpleNamespace(soon=planned.append, turn=turn, planned=planned)


def test_a_turn_begins_so_much_and_the_rest_waits_in_order(loop):
    turns, done = TurnScheduler(loop.soon, most=2), []
    for number in range(5):
        turns.submit(lambda number=number: done.append(number))
    assert (done, len(loop.planned)) == ([], 1)
    for expected in ([0, 1], [0, 1, 2, 3], [0, 1, 2, 3, 4]):
        loop.turn()
        assert done == expected
    assert loop.planned == []


def test_work_that_fails_or_brings_more_keeps_no_other_waiting(loop):
    turns, done = TurnScheduler(loop.soon, most=1), []

    def fails():
        turns.submit(lambda: done.append("more"))
        raise OSError("it failed")

    turns.submit(fails)
    turns.submit(lambda: done.append("next"))
    with pytest.raises(OSError, match="it failed"):
        loop.turn()
    loop.turn()
    loop.turn()
    assert done == ["next", "more"]


@pytest.fixture
def socket(monkeypatch):
    """One that is open, on a clock that stands; `cut` says whether it was cut off."""
    monkeypatch.setattr(
        "evaweb.console.websocket_limits.WebSocketProtocol.onPing",
        lambda self, payload: self.heard.append(payload),
    )
    monkeypatch.setattr(
        "evaweb.console.websocket_limits.WebSocketProtocol.onPong", lambda self, payload: None
    )
    monkeypatch.setattr(
        "evaweb.console.websocket_limits.WebSocketProtocol.onMessageFrameBegin", lambda self, n: None
    )
    monkeypatch.setattr(
        "evaweb.console.websocket_limits.WebSocketProtocol.onMessage", lambda self, *message: None
    )
    monkeypatch.setattr(
        "evaweb.console.websocket_limits.WebSocketProtocol.dropConnection",
        lambda self, abort: self.cut.append(self.wasNotCleanReason),
    )
    made = LimitedWebSocket()
    made.heard, made.cut, made._parts, made._quota = [], [], 0, MessageQuota(lambda: 0.0)
    return made


def test_pings_and_pongs_beyond_the_quota_end_the_socket(socket):
    allowed = int(AT_ONCE) // PING
    for _ in range(allowed - 1):
        socket.onPing(b"")
    socket.onPong(b"")
    assert (len(socket.heard), socket.cut) == (allowed - 1, [])
    socket.onPing(b"")
    assert (len(socket.heard), socket.cut) == (allowed - 1, ["too many pings"])


def test_a_message_in_endless_parts_ends_the_socket_and_many_messages_do_not(socket):
    for _ in range(3 * _MOST_PARTS):
        socket.onMessageFrameBegin(5)
        socket.onMessage(b"hello", False)
    assert socket.cut == []
    for _ in range(_MOST_PARTS + 1):
        socket.onMessageFrameBegin(0)
    assert socket.cut == [f"a message in more than {_MOST_PARTS} parts"]


class Wire(FileDescriptor):
    """A connection of Twisted's whose other end reads as much as the test says."""

    def __init__(self):
        super().__init__(SimpleNamespace(addWriter=lambda writer: None, removeWriter=lambda writer: None))
        self.connected, self.takes = 1, 0

    def writeSomeData(self, data):
        return min(self.takes, len(data))


class Reader:
    """The other end of an answer, which reads `bytes_a_look` each time that we look; time stands else."""

    def __init__(self, bytes_a_look):
        self.now, self.aborted = 0.0, False
        self.wire = Wire()
        self.wire.takes = bytes_a_look
        self.wire.abortConnection = lambda: setattr(self, "aborted", True)
        self.request = SimpleNamespace(
            channel=SimpleNamespace(transport=SimpleNamespace(transport=self.wire))
        )

    async def sleep(self, seconds):
        self.now += seconds
        self.wire.doWrite()

    def wait(self):
        asyncio.run(until_read(self.request, lambda: self.now, self.sleep))


def test_the_next_piece_of_a_download_waits_until_the_one_before_is_read():
    reader = Reader(bytes_a_look=1000)
    reader.wire.write(b"x" * (AHEAD + 5000))
    reader.wait()
    assert unsent(reader.wire) == AHEAD
    assert not reader.aborted
    at_once = reader.now
    reader.wait()
    assert reader.now == at_once


def test_a_download_that_nobody_reads_is_cut_off_and_a_slow_one_is_not():
    slow, deaf = Reader(bytes_a_look=1), Reader(bytes_a_look=0)
    for reader in (slow, deaf):
        reader.wire.write(b"x" * (AHEAD + 2000))
        reader.wait()
    assert (slow.aborted, deaf.aborted) == (False, True)
    assert slow.now > STALLED_S
    assert deaf.now == pytest.approx(STALLED_S, abs=0.2)


def test_nobody_waits_for_a_connection_that_is_gone():
    reader = Reader(bytes_a_look=0)
    reader.wire.write(b"x" * (AHEAD + 1))
    reader.request.channel = None
    reader.wait()
    assert (reader.now, reader.aborted) == (0.0, False)


def test_a_page_that_does_not_read_is_cut_off_and_one_that_does_is_not(socket, settings, monkeypatch):
    settings.EVA_UNREAD_BYTES = 1000
    monkeypatch.setattr(
        WebSocketProtocol, "sendData", lambda self, data: self.transport.transport.write(data)
    )
    wire = Wire()
    socket.transport = SimpleNamespace(transport=wire)
    for _ in range(4):  # three times as much as may lie there
        socket.sendData(b"x" * 750)
        wire.takes = 500
        wire.doWrite()
        wire.doWrite()
    assert (unsent(wire), socket.cut) == (0, [])
    wire.takes = 0
    socket.sendData(b"x" * 1000)
    wire.doWrite()
    assert (unsent(wire), socket.cut) == (1000, [])
    socket.sendData(b"x")
    assert socket.cut == ["more than 1000 bytes were not read"]
