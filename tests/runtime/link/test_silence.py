"""Silence on either side, on clocks of the test: who says nothing for too long is lost, and what was asked with him."""

from __future__ import annotations

from types import MappingProxyType

import pytest
import zmq

from runtime.ipc.bus import Endpoints
from runtime.link import key_files
from runtime.link.admission import Admission, Allowed, AllowList
from runtime.link.door import Door
from runtime.link.gate import Gate
from runtime.link.key_files import KeyPair, KnownLab
from runtime.link.line import Dial, Line, dialled
from runtime.link.wire import (
    COMMANDS,
    COORDINATOR,
    GUARD,
    LARGEST_ANSWER,
    LOST_S,
    RELEASE,
    STOPS,
    Ask,
    Beat,
    Hello,
    Welcome,
    write,
)
from tests.processes import PATIENCE_MS, eventually

STATION = "bench-7"
LAB, ROBOT = KeyPair.from_secret(bytes(range(32))), KeyPair.from_secret(bytes(range(1, 33)))
ALLOWED = Allowed(MappingProxyType({ROBOT.public.hex(): frozenset({STATION})}))


class Clock:
    def __init__(self):
        self.now = 1000.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def door(clock):
    """A port of a lab that says what the test says."""
    context = zmq.Context()
    allowed = AllowList(ALLOWED)
    admission = Admission([context], allowed)
    admission.start()
    made = Door(context, "127.0.0.1", 0, LAB, LARGEST_ANSWER, 1e9, allowed, clock)
    yield made
    made.close()
    admission.end()
    context.destroy(linger=0)


@pytest.fixture
def line(door, clock):
    context = zmq.Context()
    known = KnownLab(STATION, "a lab", "127.0.0.1", door.port, door.port, LAB.public.hex(), "00" * 32)
    made = Line(context, Dial(known, ROBOT, STOPS, b"session"), clock=clock)
    yield made
    made.close()
    context.destroy(linger=0)


def turned(line, door):
    """What the line hears, and what has arrived at the door, in one turn of both."""
    return line.turn(), door.arrivals()


def greeted(line, door):
    """Its connection, once it is there."""

    def met():
        _, arrivals = turned(line, door)
        for arrival in arrivals:
            if isinstance(arrival.message, Hello):
                door.send(arrival.route, Welcome(RELEASE, "a test"))
                return arrival.route
        return b""

    route = eventually(met, "the greeting")
    eventually(lambda: turned(line, door) and line.up, "the welcome")
    return route


def test_a_lab_that_says_nothing_is_left_and_dialled_anew(line, door, clock):
    first = greeted(line, door)
    clock.now += LOST_S - 0.01
    assert line.turn() == []
    assert line.up
    clock.now += 0.02
    line.turn()
    assert not line.up
    assert "no message from the lab for 0.9 s" in line.why
    clock.now += 1.0
    assert greeted(line, door) != first


def test_what_was_asked_before_a_silence_is_never_read(line, door, clock):
    """It has arrived, and lies in the connection that is dropped: the robot was left alone meanwhile."""
    route = greeted(line, door)
    assert door.send(route, Ask(1, COORDINATOR, "commands"), b"a command")
    assert line.socket.poll(PATIENCE_MS)
    clock.now += LOST_S + 0.01
    assert line.turn() == []
    clock.now += 1.0
    second = greeted(line, door)
    assert door.send(second, Ask(2, COORDINATOR, "commands"), b"another")
    heard = eventually(line.turn, "the second command")
    assert [message.number for message, _ in heard] == [2]


def test_a_lab_that_nobody_answers_for_is_tried_less_and_less_often(door, clock):
    context = zmq.Context()
    known = KnownLab(STATION, "a lab", "127.0.0.1", 1, 1, LAB.public.hex(), "00" * 32)
    line = Line(context, Dial(known, ROBOT, STOPS, b"session"), clock=clock)
    pauses = []
    try:
        for _ in range(6):
            line.turn()
            clock.now += 2.1
            eventually(lambda: line.turn() == [] and line.socket is None, "the end of a try")
            pauses.append(round(line._again_at - clock.now, 3))
            clock.now = line._again_at
    finally:
        line.close()
        context.destroy(linger=0)
    assert pauses == [0.1, 0.2, 0.4, 0.8, 1.6, 2.0]


# --- the gate ---------------------------------------------------------------------------------------------------------


class Played:
    """A station's two connections, by hand."""

    def __init__(self, gate, session=b"session"):
        self.gate, self.context = gate, zmq.Context()
        self.sockets = {}
        for role in (STOPS, COMMANDS):
            dealer, _ = dialled(self.context, f"tcp://127.0.0.1:{gate.port}", LAB.public, ROBOT)
            dealer.send_multipart(write(Hello(RELEASE, "a test", STATION, role, session)))
            self.sockets[role] = dealer
        self.beat()

    def beat(self, *roles, listening=(GUARD, COORDINATOR)):
        for role in roles or self.sockets:
            self.sockets[role].send_multipart(write(Beat(bytes(16), list(listening))))

    def close(self):
        self.context.destroy(linger=0)


@pytest.fixture
def gate(tmp_path, clock):
    made = Gate(
        tmp_path,
        LAB,
        key_files.tokens_key(tmp_path),
        AllowList(ALLOWED),
        lambda *asked: "",
        ("127.0.0.1", 0, 0),
        clock,
    )
    yield made
    made.close()


def links(gate, clock, played):
    """Turn until it is linked."""

    def turn():
        played.beat()
        pass_time(gate, clock, 0.05)
        return gate.linked()

    eventually(turn, "the link")


@pytest.fixture
def played(gate, clock):
    made = Played(gate)
    try:
        links(gate, clock, made)
        yield made
    finally:
        made.close()


def pass_time(gate, clock, seconds):
    clock.now += seconds
    gate.turn(0)


def test_a_station_that_says_nothing_is_lost_within_its_time(gate, played, clock, tmp_path):
    def heard():  # it is linked by the first words of both connections, however long ago those of one were
        played.beat()
        pass_time(gate, clock, 0)
        return all(line.heard_at == clock.now for line in gate._remotes[STATION].lines.values())

    eventually(heard, "both connections")
    pass_time(gate, clock, LOST_S - 0.01)
    assert gate.linked() == {STATION}
    pass_time(gate, clock, 0.06)

    def lost():  # a beat that was on its way all the while counts from when it comes
        pass_time(gate, clock, 0 if gate.linked() == set() else LOST_S + 0.01)
        return gate.linked() == set()

    eventually(lost, "the loss")
    endpoints = Endpoints(tmp_path / "stations" / STATION)
    assert "link to its computer is lost" in endpoints.read("link")["why"]


def test_which_processes_listen_is_heard_over_one_of_both_connections(gate, played, clock, monkeypatch):
    """What the other says may be older: a station that had been linked was lost and linked anew."""
    arrived, arrivals = [], gate._door.arrivals
    monkeypatch.setattr(gate._door, "arrivals", lambda: [arrived.append(one) or one for one in arrivals()])
    played.beat(STOPS, listening=[])

    def heard():
        pass_time(gate, clock, 0)
        assert gate.linked() == {STATION}
        return any(getattr(one.message, "listening", None) == [] for one in arrived)

    eventually(heard, "the beat")


def test_a_gate_that_was_kept_busy_hears_first_and_judges_then(gate, played, clock, monkeypatch):
    """Its own pause is nobody's silence, whichever of the two connections is read first."""
    arrived, arrivals = [], gate._door.arrivals
    played.beat()
    eventually(
        lambda: arrived.extend(arrivals()) or len({one.route for one in arrived}) == 2,
        "two signs of life",
    )
    for order in (arrived, arrived[::-1]):
        monkeypatch.setattr(gate._door, "arrivals", lambda order=order: order)
        pass_time(gate, clock, 2.0)
        assert gate.linked() == {STATION}


def test_a_station_of_which_one_connection_is_mute_is_lost(gate, played, clock):
    eventually(
        lambda: played.beat(COMMANDS) or pass_time(gate, clock, 0.05) or not gate.linked(),
        "the end of the link",
    )
    assert gate._remotes[STATION].line(COMMANDS, clock.now) is not None


def test_another_program_with_the_same_key_takes_the_place_of_the_first(gate, played, clock):
    other = Played(gate, b"another session")
    try:
        eventually(lambda: pass_time(gate, clock, 0.05) or not gate.linked(), "the end of the first")
        links(gate, clock, other)
        assert gate._remotes[STATION].session == b"another session"
    finally:
        other.close()
