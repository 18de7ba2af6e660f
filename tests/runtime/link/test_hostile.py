"""What a hostile computer sends to a lab's ports: bounded, and noticed by nobody else."""

import contextlib
import random
import socket

import pytest
import zmq

from runtime.link import key_files
from runtime.link.line import dialled
from runtime.link.wire import (
    LARGEST_ANSWER,
    RELEASE,
    STATE,
    STOPS,
    Answer,
    Beat,
    Bundle,
    Bye,
    Credit,
    Hello,
    Welcome,
    read,
    write,
)
from tests.processes import PATIENCE_MS, PATIENCE_S, eventually
from tests.runtime.link.linked import STATION, allowed

OTHER = "bench-8"


class Hostile:
    """Another station of the lab, with a key that is allowed, that says what it likes."""

    def __init__(self, lab, port):
        self.key = key_files.KeyPair.from_secret(bytes(range(1, 33)))
        self.context = zmq.Context()
        self.lab, self.port = lab, port
        self.dial()

    def dial(self):
        self.dealer, self.monitor = dialled(
            self.context, f"tcp://127.0.0.1:{self.port}", self.lab.key.public, self.key
        )

    def greet(self, role):
        """The lab's welcome; dialled anew where a machine that stood still let the handshake run out."""
        hello = write(Hello(RELEASE, "0", OTHER, role, b"hostile"))
        self.dealer.send_multipart(hello)

        def answer():
            if self.dealer.poll(0):
                return self.said()
            if self.monitor.poll(0):
                self.dial()
                self.dealer.send_multipart(hello)
            return None

        said = eventually(answer, "an answer of the lab")
        return said if isinstance(said, Welcome) else None

    def said(self):
        assert self.dealer.poll(PATIENCE_MS), "the lab says nothing"
        return read(self.dealer.recv_multipart())[0]

    def is_cut_off(self):
        while self.dealer.poll(0):  # its own library tells it once it has read what came before
            self.dealer.recv_multipart()
        return bool(self.monitor.poll(0))

    def close(self):
        self.context.destroy(linger=0)


@pytest.fixture
def hostile(lab, linked):
    lab.allowed.now = allowed(
        (linked.key, STATION), (key_files.KeyPair.from_secret(bytes(range(1, 33))), OTHER)
    )
    made = Hostile(lab, lab.gate.port)
    yield made
    made.close()


@pytest.fixture
def hostile_streams(lab, linked):
    lab.allowed.now = allowed(
        (linked.key, STATION), (key_files.KeyPair.from_secret(bytes(range(1, 33))), OTHER)
    )
    eventually(lambda: OTHER in lab.gate._streams.places, "the other station")
    made = Hostile(lab, lab.gate.second_port)
    yield made
    made.close()


def test_bytes_that_are_no_handshake_end_nothing(lab, linked):
    noise = random.Random(7)
    for port in (lab.gate.port, lab.gate.second_port):
        for size in (0, 1, 9, 64, 5000):
            with socket.create_connection(("127.0.0.1", port)) as raw:
                raw.sendall(noise.randbytes(size))
    assert lab.press().status == "done"
    assert lab.gate.linked() == {STATION}


@pytest.mark.some(2)
@pytest.mark.parametrize(
    "frames",
    [
        [b""],
        [b"\x00" * 5000],
        [b"\xc1"],
        [b"\x81" * 3000],
        [b"x"] * 66,
        [*write(Bye("now"))],
        [*write(Answer(1))],
        [*write(Beat())],
    ],
    ids=["empty", "long", "broken", "deep", "many", "bye", "answer", "beat"],
)
def test_who_says_nothing_that_can_be_read_or_not_who_it_is_is_cut_off(lab, hostile, frames):
    hostile.dealer.send_multipart(frames)
    assert isinstance(hostile.said(), Bye)
    eventually(hostile.is_cut_off, "the end of the connection")
    assert lab.press().status == "done"


def test_a_message_that_is_too_large_costs_its_sender_the_connection(lab, hostile):
    assert hostile.greet(STOPS)
    hostile.dealer.send(b"x" * (LARGEST_ANSWER + 1))
    eventually(hostile.is_cut_off, "the end of the connection")
    assert lab.press().status == "done"


@pytest.mark.some(1)
@pytest.mark.parametrize(
    ("said", "word"), [(write(Answer(1), bytes(1 << 20)), "MB"), (write(Beat()), "messages")]
)
def test_a_flood_is_cut_off_and_keeps_nobody_elses_press(lab, hostile, caplog, said, word):
    assert hostile.greet(STOPS)

    def flooded():
        for _ in range(1000):
            if not hostile.dealer.poll(0, zmq.POLLOUT):
                break
            hostile.dealer.send_multipart(said, zmq.NOBLOCK)
        return hostile.is_cut_off()

    assert not flooded()
    assert lab.press().status == "done"
    eventually(flooded, "the end of the connection")
    assert f"{word} a second; allowed" in caplog.text
    assert lab.press().status == "done"


def test_a_station_answers_for_no_other(lab, linked, hostile):
    """Numbers of questions are easily guessed: an answer counts from the station that was asked."""
    assert hostile.greet(STOPS)
    linked.station.mute = True
    for number in range(1, 400):
        hostile.dealer.send_multipart(write(Answer(number), b"forged"))
    linked.station.mute = False
    answer = lab.press()
    assert (answer.status, answer.reason) == ("done", "every tick now sends the measured position")


def test_a_greeting_in_anothers_name_is_refused(lab, linked, hostile):
    hostile.dealer.send_multipart(write(Hello(RELEASE, "0", STATION, STOPS, b"hostile")))
    assert "not known here with this key" in hostile.said().why
    assert lab.gate.linked() == {STATION}
    assert lab.press().status == "done"


def test_streams_that_nobody_has_asked_for_are_cut_off(lab, linked, hostile_streams):
    assert hostile_streams.greet(STATE)
    for _ in range(40):
        hostile_streams.dealer.send_multipart(write(Bundle(["state"]), b"x"))
    eventually(hostile_streams.is_cut_off, "the end of the connection")
    assert lab.hears("coordinator", "state", "state")


def test_a_stream_of_another_name_is_published_nowhere(lab, linked, hostile_streams):
    assert hostile_streams.greet(STATE)
    subscriber = zmq.Context.instance().socket(zmq.SUB)
    subscriber.subscribe(b"")
    subscriber.connect(lab.gate._streams.places[OTHER][0])
    try:
        assert isinstance(hostile_streams.said(), Credit)
        names = ["camera/cam_high", "State", "../x", "state\n", "x" * 50, "", "state"]
        hostile_streams.dealer.send_multipart(write(Bundle(names), *[name.encode() for name in names]))
        assert subscriber.poll(PATIENCE_MS)
        assert subscriber.recv_multipart() == [b"state", b"state"]
    finally:
        subscriber.close(linger=0)


def test_who_connects_and_says_nothing_is_let_go(lab, linked, monkeypatch):
    monkeypatch.setattr("runtime.link.door._NAMED_S", 0.5)
    with socket.create_connection(("127.0.0.1", lab.gate.port)) as raw:
        raw.settimeout(PATIENCE_S)
        with contextlib.suppress(ConnectionResetError):
            while raw.recv(4096):
                pass
    assert lab.press().status == "done"
