"""What the coordinator's socket believes, refuses and does first, over real sockets, of a station in lockstep."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest
import zmq

from runtime.ipc.bus import MAX_WAITING_PER_CONNECTION, Endpoints, Key, Subscriber
from runtime.ipc.messages import Ack, Command, decode, encode
from runtime.ipc.session_state import SessionState
from runtime.ipc.shared_state import EStop
from runtime.processes.coordinator.process import CommandService
from tests import presses
from tests.processes import PATIENCE_MS
from tests.runtime.lockstep_station import Station, stubbed

PATIENCE = 500  # turns
PAGE = "web:ann:p1"


class Bench:
    """A station that is running, its socket, and the key of its web."""

    def __init__(self, folder: Path) -> None:
        self.context: zmq.Context[Any] = zmq.Context()
        self.station = Station(stubbed(folder))
        self.coordinator = self.station.coordinator
        self.service = CommandService(self.coordinator, self.context)
        self.folder = self.station.spec.deployment.station_dir
        self.key = Key(self.folder)

    def client(self) -> zmq.Socket[bytes]:
        made: zmq.Socket[bytes] = self.context.socket(zmq.DEALER)
        made.set_hwm(100_000)
        made.linger = 0
        made.connect(Endpoints(self.folder).read("coordinator")["commands"])
        return made

    def ask(self, client: zmq.Socket[bytes], command: Command, signed: bool = False) -> Ack:
        """The answer to that command."""
        payload = encode(command)
        client.send_multipart([payload, self.key.sign(payload)] if signed else [payload])
        for _ in range(PATIENCE):
            self.service.serve(0.01)
            while client.poll(0):
                ack = decode(client.recv())
                assert isinstance(ack, Ack)
                if ack.uuid == command.uuid:
                    return ack
        raise AssertionError(f"no answer to {command}")

    def led(self) -> Command:
        """The station has a run that a page leads; returns a stop of that page."""
        self.station.running(5)
        epoch = self.coordinator.lease.epoch + 1
        claim = Command(str(uuid4()), "lease_claim", user="ann", holder=PAGE, epoch=epoch, role="operator")
        assert self.ask(self.client(), claim, signed=True).status == "accepted"
        return Command(str(uuid4()), "stop", user="ann", holder=PAGE, epoch=epoch)

    def told(self, kind: str) -> list[dict[str, Any]]:
        return [event for event in self.coordinator.events.since(0) if event["kind"] == kind]

    def journalled(self) -> list[dict[str, Any]]:
        lines = (self.folder / "commands.jsonl").read_text("utf-8").splitlines()
        return [json.loads(line) for line in lines]

    def close(self) -> None:
        self.station.close()
        self.service.close()
        self.context.destroy(linger=0)


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    made = Bench(tmp_path)
    yield made
    made.close()


def test_who_the_web_signs_for_is_in_the_events_the_journal_and_the_lease(bench: Bench) -> None:
    stop = bench.led()
    assert bench.coordinator.snapshot()["lease"]["by"] == "ann (operator)"
    assert bench.ask(bench.client(), stop, signed=True).status == "accepted"
    event = bench.told("command")[-1]
    assert (event["data"]["user"], event["data"]["role"], event["data"]["holder"]) == ("ann", "", PAGE)
    assert [(row["user"], row["role"]) for row in bench.journalled()[-2:]] == [
        ("ann", "operator"),
        ("ann", ""),
    ]


@pytest.mark.parametrize("kind", ["stop", "halt"])
@pytest.mark.parametrize("signature", [b"", b"made up"])
def test_a_stop_that_cannot_be_verified_is_obeyed_and_recorded_so(
    bench: Bench, kind: str, signature: bytes
) -> None:
    stop = replace(bench.led(), kind=kind)
    client = bench.client()
    client.send_multipart([encode(stop), signature] if signature else [encode(stop)])
    for _ in range(PATIENCE):
        bench.service.serve(0.01)
        if bench.coordinator.session.state is not SessionState.RUNNING:
            break
    assert bench.coordinator.session.state is (SessionState.READY if kind == "stop" else SessionState.HOLDING)
    (event,) = [event for event in bench.told("command") if event["data"]["uuid"] == stop.uuid]
    assert event["text"] == f"{kind} by ann (unverified): accepted"
    assert bench.journalled()[-1]["role"] == "unverified"


@pytest.mark.some(3)
@pytest.mark.parametrize("kind", ["setup", "run", "release", "lease_claim", "lease_renew", "aim"])
def test_all_else_that_cannot_be_verified_is_refused_and_told(bench: Bench, kind: str) -> None:
    bench.led()
    said = Command("forged", kind, user="root", holder="web:root:p1", epoch=99, role="admin")
    ack = bench.ask(bench.client(), said)
    assert (ack.status, "not signed by this lab's web" in ack.reason) == ("refused", True)
    assert bench.told("not_allowed")[-1]["text"].startswith(f"{kind} by root (unverified): refused")
    assert bench.coordinator.snapshot()["lease"]["holder"] == PAGE
    assert bench.coordinator.session.answered(said) is None, "whose uuid it is has its own answer"


def test_a_viewer_whom_the_web_signs_for_may_look_and_stop(bench: Bench) -> None:
    stop = bench.led()
    run = Command(str(uuid4()), "resume", user="vera", holder="web:vera:p1", role="viewer")
    ack = bench.ask(bench.client(), run, signed=True)
    assert (ack.status, ack.reason) == ("refused", "resume needs an operator; vera is viewer")
    status = replace(run, uuid="s", kind="status")
    assert bench.ask(bench.client(), status, signed=True).status == "done"
    assert bench.ask(bench.client(), replace(stop, user="vera", role="viewer"), True).status == "accepted"


def test_without_its_key_a_station_still_stops_and_refuses_the_rest(bench: Bench) -> None:
    stop = bench.led()
    client = bench.client()
    signature = bench.key.sign(encode(stop))
    (bench.folder / "bus.key").chmod(0o644)
    client.send_multipart([encode(stop), signature])
    for _ in range(PATIENCE):
        bench.service.serve(0.01)
        if bench.coordinator.session.state is SessionState.READY:
            break
    assert bench.coordinator.session.state is SessionState.READY


def test_repeats_of_a_stop_get_the_first_ones_answer_and_one_line(bench: Bench) -> None:
    stop = bench.led()
    client, lines = bench.client(), len(bench.journalled())
    for number in range(300):  # each with a uuid of its own, as an impatient person presses
        payload = encode(replace(stop, uuid=str(number)))
        client.send_multipart([payload, bench.key.sign(payload)])
    found: list[Ack] = []
    turns = 0
    while len(found) < 300 and turns < 20:
        turns += 1
        bench.service.serve(0.1)
        while client.poll(50):
            ack = decode(client.recv())
            assert isinstance(ack, Ack)
            found.append(ack)
    assert [ack.uuid for ack in found] == [str(number) for number in range(300)]
    assert found[0].status == "accepted"
    assert len(bench.journalled()) - lines <= turns
    assert sum(event["text"].startswith("stop") for event in bench.told("command")) <= turns


def test_a_flood_of_questions_is_told_once_and_a_stop_is_answered_in_a_few_turns(bench: Bench) -> None:
    stop = bench.led()
    noisy, client = bench.client(), bench.client()
    for number in range(5000):
        noisy.send(encode(Command(str(number), "status")))
    payload = encode(stop)
    client.send_multipart([payload, bench.key.sign(payload)])
    asked = 0
    handle = bench.coordinator.handle

    def counted(command: Command) -> Ack:
        nonlocal asked
        asked += command.kind == "status"
        return handle(command)

    bench.coordinator.handle = counted  # type: ignore[method-assign]
    turns = 0
    while not client.poll(0):
        turns += 1
        bench.service.serve(0.1)
        assert asked <= 8 * turns
        client.poll(20)
        assert turns < 20
    ack = decode(client.recv())
    assert isinstance(ack, Ack)
    assert (ack.uuid, ack.status) == (stop.uuid, "accepted")
    for _ in range(30):
        bench.service.serve(0.0)
    assert len(bench.told("flood")) == 1
    assert f"more than {MAX_WAITING_PER_CONNECTION} requests at once" in bench.told("flood")[0]["text"]


def test_a_press_at_the_wrong_socket_stops_the_robot_and_is_latched_by_the_guard(bench: Bench) -> None:
    bench.station.running(5)
    assert bench.ask(bench.client(), Command("p", "estop", {"why": "smoke"})).status == "accepted"
    assert bench.coordinator.shared.estop is EStop.LATCHED
    bench.station.go(40)
    assert bench.coordinator.session.state is SessionState.FAULTED
    assert json.loads((bench.folder / "estop.json").read_text("utf-8"))["why"] == "smoke"
    assert bench.journalled()[-1]["kind"] == "estop"
    assert bench.told("command")[-1]["text"].endswith(": accepted, smoke")


def test_whatever_is_wrong_with_a_press_at_the_wrong_socket_it_is_pressed(bench: Bench) -> None:
    shared, client = bench.coordinator.shared, bench.client()
    for name, payload in presses.PACKED.items():
        shared.set_estop(EStop.CLEAR)
        client.send(payload)
        assert bench.service._server.socket.poll(PATIENCE_MS)
        bench.service.serve(0.0)
        assert (name, shared.estop) == (name, EStop.LATCHED)
        answer = decode(client.recv())
        assert isinstance(answer, Ack)
        assert answer.status == "accepted"


def test_a_press_whose_uuid_was_anothers_is_pressed(bench: Bench) -> None:
    stop = bench.led()
    assert bench.ask(bench.client(), stop, signed=True).status == "accepted"
    press = Command(stop.uuid, "estop", user="ann", holder=PAGE)
    assert bench.ask(bench.client(), press).status == "accepted"
    assert bench.coordinator.shared.estop is EStop.LATCHED


def test_streams_that_nobody_reads_are_not_made_and_who_begins_to_read_has_them_at_once(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[str] = []
    monkeypatch.setattr(bench.service, "_poses", lambda: made.append("poses") or {"poses": 1})
    monkeypatch.setattr(bench.service, "_joints", lambda: made.append("joints") or {"joints": 1})
    for _ in range(3):
        bench.service.serve(0.0)
        bench.station.go(10)
    assert made == []
    assert bench.service.until_due() == float("inf")
    where = Endpoints(bench.folder).read("coordinator")["state"]
    with closing(Subscriber(bench.context, where, "poses", "state")) as reader:
        found: dict[str, Any] = {}
        for _ in range(PATIENCE):
            bench.service.serve(0.01)
            found |= reader.receive(0.0)
            if len(found) == 2:
                break
        assert found["poses"] == {"poses": 1}
        assert found["state"]["state"] == str(bench.coordinator.session.state)
        assert bench.service.until_due() < 0.1
    assert set(made) == {"poses"}


def test_a_station_rests_until_somebody_can_command_it_or_something_goes_on(bench: Bench) -> None:
    bench.station.reach(SessionState.IDLE)
    now, lease = bench.coordinator.client_clock.now(), bench.coordinator.lease
    held = lease.current(now)  # by who plays the operator in lockstep
    assert held is not None
    assert not bench.coordinator.rests
    assert lease.release(held.holder, held.epoch, now) == ""
    assert bench.coordinator.rests
    epoch = lease.epoch + 1
    claim = Command(str(uuid4()), "lease_claim", user="ann", holder=PAGE, epoch=epoch, role="operator")
    assert bench.ask(bench.client(), claim, signed=True).status == "accepted"
    assert not bench.coordinator.rests
    give_up = replace(claim, uuid=str(uuid4()), kind="lease_give_up")
    assert bench.ask(bench.client(), give_up, signed=True).status == "accepted"
    assert bench.coordinator.rests
    bench.station.running(5)
    assert not bench.coordinator.rests
