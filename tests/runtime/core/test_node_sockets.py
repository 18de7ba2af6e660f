from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import closing

import pytest
import zmq

from runtime.core.errors import SetupError
from runtime.core.node_sockets import Sockets
from tests.processes import PATIENCE_S

FREE = "tcp://127.0.0.1:0"


@pytest.fixture
def sockets() -> Iterator[Sockets]:
    with closing(Sockets(FREE, FREE, insecure=False)) as made:
        yield made


def peer(kind: int, address: str) -> zmq.Socket[bytes]:
    socket: zmq.Socket[bytes] = zmq.Context.instance().socket(kind)
    socket.setsockopt(zmq.LINGER, 0)
    if kind == zmq.SUB:
        socket.setsockopt(zmq.SUBSCRIBE, b"")
    socket.connect(address)
    return socket


def test_commands_come_in_order_and_all_that_have_come(sockets: Sockets) -> None:
    assert sockets.received() == []
    with closing(peer(zmq.PUB, sockets.addresses["action_endpoint"])) as commands:
        deadline, heard = time.monotonic() + PATIENCE_S, []
        while not heard and time.monotonic() < deadline:
            commands.send(b"hello")
            time.sleep(0.005)  # a queue that is full of greetings would drop what comes after them
            heard = sockets.received()
        for number in range(5):
            commands.send(b"%d" % number)
        while heard[-1] != b"4" and time.monotonic() < deadline:
            heard += sockets.received()
    assert [payload for payload in heard if payload != b"hello"] == [b"0", b"1", b"2", b"3", b"4"]


def test_an_observation_reaches_who_listens_and_without_anybody_is_dropped(sockets: Sockets) -> None:
    sockets.publish(b"nobody")
    with closing(peer(zmq.SUB, sockets.addresses["obs_endpoint"])) as listener:
        deadline = time.monotonic() + PATIENCE_S
        while not listener.poll(10) and time.monotonic() < deadline:
            sockets.publish(b"frame")
        assert listener.recv() == b"frame"


def test_an_address_that_is_taken_is_named(sockets: Sockets) -> None:
    taken = sockets.addresses["action_endpoint"]
    with pytest.raises(SetupError, match=f"cannot bind {taken}"):
        Sockets(FREE, taken, insecure=False)


def test_an_address_for_others_needs_to_be_allowed() -> None:
    with pytest.raises(SetupError, match="add --insecure-link"):
        Sockets(FREE, "tcp://0.0.0.0:0", insecure=False)
    with closing(Sockets(FREE, "tcp://0.0.0.0:0", insecure=True)) as open_to_all:
        assert open_to_all.addresses["action_endpoint"].startswith("tcp://0.0.0.0:")
