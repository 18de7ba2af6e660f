"""What one computer does at a lab's ports, and no other station may notice."""

import contextlib
import socket

import pytest
import zmq

from runtime.core.errors import CodecError
from runtime.ipc.bus import CommandClient, Endpoints, Key
from runtime.ipc.messages import Ack, Command, decode, encode
from runtime.link import door, gate, key_files, wire
from runtime.link.admission import Admission, AllowList
from runtime.link.line import dialled
from runtime.link.wire import COMMANDS, RELEASE, STOPS, Ask, Beat, Bye, Hello, Welcome, read, write
from tests.processes import PATIENCE_S, eventually
from tests.runtime.link.linked import STATION, allowed

OTHER = "bench-8"
KEY = key_files.KeyPair.from_secret(bytes(range(1, 33)))
CHALLENGE = b"c" * 16


@pytest.fixture
def dial(lab, linked):
    """Connections of another station of this lab, whose computer says what it likes."""
    lab.allowed.now = allowed((linked.key, STATION), (KEY, OTHER))
    eventually(lambda: OTHER in lab.gate._streams.places, "the other station")
    context = zmq.Context()
    yield lambda: dialled(context, f"tcp://127.0.0.1:{lab.gate.port}", lab.key.public, KEY)
    context.destroy(linger=0)


def said(dealer, kind):
    def heard():
        while dealer.poll(0):
            message, _ = read(dealer.recv_multipart())
            if isinstance(message, kind):
                return message
        return None

    return eventually(heard, kind.__name__)


def answered(dial, kind, *messages):
    """A connection with the gate's answer of that kind to these messages.

    It is dialled anew, as by a station, where a machine that stood still let its handshake run out.
    """
    line = monitor = None

    def heard():
        nonlocal line, monitor
        while line is not None and line.poll(0):
            message, _ = read(line.recv_multipart())
            if isinstance(message, kind):
                return message
        if line is None or monitor.poll(0):
            line, monitor = dial()
            for message in messages:
                line.send_multipart(write(message))
        return None

    answer = eventually(heard, kind.__name__)
    return line, answer


def greeted(dial, role, *listening):
    hello = Hello(RELEASE, "0", OTHER, role, b"hostile")
    return answered(dial, Welcome, hello, Beat(CHALLENGE, list(listening)))[0]


def other_linked(lab, dial):
    lines = {role: greeted(dial, role, "guard", "coordinator") for role in (STOPS, COMMANDS)}
    lab.linked(OTHER)
    return lines


@pytest.fixture
def pressed(lab, dial):
    """A press of the other station's e-stop, on its way; its answer."""
    folder = lab.folder(OTHER)
    endpoint = str(Endpoints(folder).read("guard")["estop"])
    client = CommandClient(zmq.Context.instance(), endpoint, Key(folder))

    def answer():
        packed = eventually(client.packed_answer, "the answer")
        return decode(packed)

    def press():
        client.send(Command("p1", "estop", {"why": "a test"}, user="ann", holder="ann", role="operator"))
        return answer

    yield press
    client.close()


@pytest.mark.parametrize("field", ["kind", "challenge"])
def test_what_is_nested_deeper_than_python_is_refused_as_any_noise(field):
    depth = 1020
    text = {"kind": b"\xa4Beat", "challenge": b"\xc4\x00"} | {field: b"\x91" * depth + b"\xc0"}
    header = b"\x82" + b"".join(bytes([0xA0 + len(key)]) + key.encode() + text[key] for key in text)
    with pytest.raises(CodecError, match="list"):
        wire.read([header])


def test_a_program_of_another_release_unlinks_no_station_that_is_linked(lab, dial):
    """Its socket for commands was closed under those who wait for answers, and the first answer ended the gate."""
    lines = other_linked(lab, dial)
    folder = lab.folder(OTHER)
    client = CommandClient(
        zmq.Context.instance(), str(Endpoints(folder).read("coordinator")["commands"]), Key(folder)
    )
    try:
        client.send(Command("u1", "status", user="ann", holder="ann", role="operator"))
        asked = said(lines[COMMANDS], Ask)
        _, bye = answered(dial, Bye, Hello(RELEASE + 9, "9", OTHER, STOPS, b"older"))
        assert "they work one apart" in bye.why
        lines[COMMANDS].send_multipart(write(wire.Answer(asked.number), b"whatever it likes"))
        packed = eventually(client.packed_answer, "the answer")
        assert packed == b"whatever it likes"
    finally:
        client.close()
    assert lab.gate.linked() == {STATION, OTHER}


@pytest.mark.parametrize(("kind", "role"), [("status", COMMANDS), ("stop", STOPS)])
def test_a_command_that_the_station_never_answers_is_answered_by_the_gate(lab, dial, monkeypatch, kind, role):
    monkeypatch.setattr(gate, "_PENDING_S", 0.0)
    lines = other_linked(lab, dial)
    folder = lab.folder(OTHER)
    endpoint = str(Endpoints(folder).read("coordinator")["commands"])
    with contextlib.closing(CommandClient(zmq.Context.instance(), endpoint, Key(folder))) as client:
        client.send(Command("u1", kind, user="ann", holder="ann", role="operator"))
        asked = said(lines[role], Ask)
        ack = decode(eventually(client.packed_answer, "the answer"))
        assert (ack.uuid, ack.status) == ("u1", "failed"), "it may have been carried out"
        assert "sent and not answered within" in ack.reason
        lines[role].send_multipart(write(wire.Answer(asked.number), b"too late"))
        monkeypatch.setattr(gate, "_PENDING_S", PATIENCE_S)
        assert lab.press().status == "done"


def test_a_message_of_nothing_but_parts_keeps_no_press_and_its_key_is_refused_for_a_while(
    lab, dial, monkeypatch
):
    """Pyzmq's own way to read it took 3 s for these, and every link was lost meanwhile."""
    monkeypatch.setattr(door, "_TURN_PARTS", 50)
    monkeypatch.setattr(door, "_UNNAMED_BYTES", 1 << 20)
    whole, _ = dial()
    for _ in range(500):
        whole.send(b"", zmq.SNDMORE)
    whole.send(b"")
    assert "frames" in said(whole, Bye).why
    assert lab.press().status == "done"
    refused, asked = [], lab.allowed.refused
    monkeypatch.setattr(lab.allowed, "refused", lambda *given: refused.append(asked(*given)) or refused[-1])
    again, _ = dial()
    again.send_multipart(write(Hello(RELEASE, "0", OTHER, STOPS, b"hostile")))
    eventually(lambda: True in refused, "the question about its key")
    assert not again.poll(200)
    lab.allowed._refused.clear()
    assert greeted(dial, STOPS)


def test_a_message_without_an_end_is_cut_off_when_it_is_longer_than_a_greeting(lab, linked, caplog):
    greeting = b"\xff" + bytes(8) + b"\x7f\x03\x01" + b"CURVE".ljust(20, b"\0") + bytes(32)
    with socket.create_connection(("127.0.0.1", lab.gate.port)) as endless:
        endless.sendall(greeting + b"\x06" + (1 << 20).to_bytes(8, "big") + bytes(40_000))
        eventually(lambda: "without a whole message" in caplog.text, "the end of it")
    assert lab.press().status == "done"


def test_a_press_is_sent_again_also_while_the_coordinator_does_not_run(lab, dial, pressed):
    """The guard alone listens: a link that was lost then took the press with it, and nobody was told."""
    stops, commands = (greeted(dial, role, "guard") for role in (STOPS, COMMANDS))
    answer = pressed()
    assert said(stops, Ask).process == "guard"
    stops.close(linger=0)
    commands.close(linger=0)
    eventually(lambda: lab.gate._remotes[OTHER].held, "what is kept")
    stops, commands = (greeted(dial, role, "guard") for role in (STOPS, COMMANDS))
    asked = eventually(lambda: asked_over(stops, commands), "the press again")
    asked[0].send_multipart(write(wire.Answer(asked[1].number), encode(Ack("p1", "done"))))
    assert answer().status == "done"


def test_a_press_is_sent_again_where_both_connections_are_lost_one_after_the_other(lab, dial, pressed):
    """The first loss held what was on its way; a press over the connection that was left went down with that."""
    stops, commands = (greeted(dial, role, "guard") for role in (STOPS, COMMANDS))
    stops.close(linger=0)
    eventually(lambda: STOPS not in lab.gate._remotes[OTHER].lines, "one connection")
    answer = pressed()
    assert said(commands, Ask).process == "guard"
    commands.close(linger=0)
    eventually(lambda: lab.gate._remotes[OTHER].held, "what is kept")
    stops, commands = (greeted(dial, role, "guard") for role in (STOPS, COMMANDS))
    asked = eventually(lambda: asked_over(stops, commands), "the press again")
    asked[0].send_multipart(write(wire.Answer(asked[1].number), encode(Ack("p1", "done"))))
    assert answer().status == "done"


def asked_over(*lines):
    for line in lines:
        while line.poll(0):
            message, _ = read(line.recv_multipart())
            if isinstance(message, Ask):
                return line, message
    return None


def test_a_press_is_sent_again_where_a_new_connection_takes_the_place_of_its_own(lab, dial, pressed):
    lines = other_linked(lab, dial)
    pressed()
    assert said(lines[STOPS], Ask).process == "guard"
    stops = greeted(dial, STOPS)
    asked = eventually(lambda: asked_over(stops, lines[COMMANDS]), "the press again")
    assert asked[1].process == "guard"


def test_who_pressed_is_told_when_the_key_is_withdrawn_meanwhile(lab, linked, dial, pressed):
    lines = other_linked(lab, dial)
    answer = pressed()
    assert said(lines[STOPS], Ask)
    lab.allowed.now = allowed((linked.key, STATION))
    assert answer().reason.startswith("USE THE HARDWARE STOP: sent and not answered, the link to bench-8")


def test_of_one_key_so_many_handshakes_are_answered_and_no_more_of_unknown_keys_from_one_address():
    """Libzmq ends a process whose peer has given itself the number that the next connection gets: 2^32, and an hour."""
    now = 1000.0
    list_of = AllowList(allowed((KEY, OTHER), enrolling=True))
    admission = Admission([], list_of, lambda: now)

    def let_in(key, address, times):
        frames = [b"1.0", b"1", b"stations", address, b"", b"CURVE"]
        return [admission.answer([*frames, key])[2] for _ in range(times)].count(b"200")

    assert let_in(KEY.public, b"10.0.0.1", 300) == 100
    assert sum(let_in(bytes([one]) * 32, b"10.0.0.1", 2) for one in range(150)) == 100
    assert let_in(b"u" * 32, b"10.0.0.2", 4) == 4
    now += 2.0
    assert let_in(KEY.public, b"10.0.0.9", 300) == 20
    list_of.now = allowed((KEY, OTHER))
    assert admission.answer([b"1.0", b"1", b"stations", b"10.0.0.1", b"", b"CURVE", b"u" * 32])[2] == b"400"


def test_of_presses_that_were_lost_with_the_link_only_the_newest_are_held(lab, dial, monkeypatch):
    """The bound held for presses without a link alone, not for those that a lost link gave back."""
    monkeypatch.setattr(gate, "_MOST_HELD", 2)
    monkeypatch.setattr(gate, "_HOPE_S", PATIENCE_S)
    lines = other_linked(lab, dial)
    folder = lab.folder(OTHER)
    endpoint = str(Endpoints(folder).read("guard")["estop"])
    with contextlib.closing(CommandClient(zmq.Context.instance(), endpoint, Key(folder))) as client:
        for number in range(4):
            client.send(Command(f"p{number}", "estop", user="ann", holder="ann", role="operator"))
            assert said(lines[STOPS], Ask).process == "guard"
        # Of another program, so that both connections are lost at once.
        stops, _ = answered(dial, Welcome, Hello(RELEASE, "0", OTHER, STOPS, b"another"))
        acks = [decode(eventually(client.packed_answer, "an answer")) for _ in range(2)]
        assert [(ack.uuid, ack.status) for ack in acks] == [("p0", "failed"), ("p1", "failed")]
        assert all("USE THE HARDWARE STOP" in ack.reason for ack in acks)
        assert [press.command.uuid for press in lab.gate._remotes[OTHER].held] == ["p2", "p3"]
        stops.send_multipart(write(Beat(CHALLENGE, ["guard"])))
        assert [said(stops, Ask).process for _ in range(2)] == ["guard", "guard"]
