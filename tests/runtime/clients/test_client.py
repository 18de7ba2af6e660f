import threading

import pytest
import zmq

from runtime.clients.client import Refused, StationClient
from runtime.core.errors import TransportError
from runtime.ipc.bus import CommandServer, Endpoints, Publisher
from runtime.ipc.command_arguments import RunRequest
from runtime.ipc.messages import Ack, Command
from runtime.ipc.session_state import SessionState
from runtime.processes.coordinator.lease import Lease
from runtime.processes.coordinator.session.machine import SessionMachine
from tests.processes import PATIENCE_MS
from tests.runtime.processes.coordinator.session.test_machine import Recorded


class Station:
    """A real session behind real sockets, answered by a thread."""

    def __init__(self, folder):
        self.folder, self.time, self.boot = folder, 1000.0, "boot-1"
        self.received, self.mute = [], False
        self.context = zmq.Context()
        self._server = CommandServer(self.context, folder, "commands")
        self.restart("boot-1")
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def restart(self, boot, state=SessionState.READY):
        self.boot, self.effects, self.lease = boot, Recorded(), Lease(5.0)
        self.session = SessionMachine(self.effects, self.lease, boot, lambda: self.time)
        self.session.state = state
        Endpoints(self.folder).write("coordinator", {"commands": self._server.endpoint})

    def _serve(self):
        while not self._ended.is_set():
            self._server.socket.poll(5)
            while (received := self._server.receive()) is not None:
                address, command = received
                self.received.append(command)
                if not self.mute:
                    self._server.answer(address, self._answer(command))
        self._server.close()

    def _answer(self, command: Command) -> Ack:
        if command.kind == "status":
            data = {"boot": self.boot, "sequence": self.session.sequence, "clock": self.time}
            data |= {"state": str(self.session.state), "reason": self.session.reason}
            return Ack(command.uuid, "done", data=data)
        if command.kind == "events_since":
            return Ack(command.uuid, "done", data={"events": [{"number": command.args["number"] + 1}]})
        if command.kind == "aim":
            known = "arm" in command.args
            return Ack(command.uuid, "done" if known else "refused", "no such arm", data={"joints": [1.0]})
        return self.session.handle(command)

    def kinds(self):
        return [command.kind for command in self.received]

    def close(self):
        self._ended.set()
        self._thread.join()
        self.context.destroy(linger=0)


@pytest.fixture
def station(tmp_path):
    made = Station(tmp_path / "stations" / "bench-1")
    yield made
    made.close()


@pytest.fixture
def connect(station):
    clients = []

    def connect(holder):
        clients.append(StationClient(station.folder, holder))
        return clients[-1]

    yield connect
    for client in clients:
        client.close()


@pytest.fixture
def client(connect):
    return connect("anna")


def test_a_command_is_given_under_the_lease_and_by_the_newest_status(client, station):
    assert client.command("run").status == "accepted"
    assert station.kinds() == ["lease_claim", "status", "run"]
    given = station.received[-1]
    assert (given.holder, given.epoch, given.boot, given.sequence) == ("anna", 1, "boot-1", 1)
    assert given.valid_until == pytest.approx(1002.0, abs=1.0)
    assert station.session.state is SessionState.RUNNING


def test_a_station_that_was_started_before_an_upgrade_is_read_as_one_of_today(client, station):
    assert client.status()["state_is"] == SessionState.READY.meaning_dict()


def test_arguments_may_have_the_words_of_the_clients_own(client, station):
    client.claim()
    client.status()
    with pytest.raises(Refused, match="timeout"):
        client.send_command("run", {"timeout": 5, "kind": "x", "identity": "y"})
    with pytest.raises(Refused, match="no such arm"):
        client.query_with("aim", {"kind": 1, "timeout": 2})
    assert [dict(command.args) for command in station.received if command.args] == [
        {"timeout": 5, "kind": "x", "identity": "y"},
        {"kind": 1, "timeout": 2},
    ]


def test_each_command_has_a_uuid_of_its_own(client, station):
    client.command("run")
    client.command("stop")
    assert len({command.uuid for command in station.received}) == len(station.received)


def test_a_repeated_identity_is_not_carried_out_twice(client, station):
    client.command("run", identity="only-once")
    client.command("stop")
    assert client.command("run", identity="only-once").status == "accepted"
    assert station.session.state is SessionState.READY


def test_a_refusal_is_raised_with_its_reason(client, station):
    with pytest.raises(Refused, match="resume is not allowed while ready"):
        client.command("resume")


def test_somebody_elses_lease_is_respected_and_named(client, connect, station):
    client.claim()
    with pytest.raises(Refused, match=r"anna holds the lease for another 5\.0 s"):
        connect("ben").command("run")
    assert station.session.state is SessionState.READY


def test_a_higher_epoch_takes_over(client, connect):
    client.claim()
    ben = connect("ben")
    ben.claim(epoch=7)
    assert ben.command("run").status == "accepted"
    with pytest.raises(Refused, match="ben holds the lease"):
        client.command("stop")


def test_a_lease_is_renewed_once_a_second_however_often_it_is_asked_for(client, station, monkeypatch):
    client.claim()
    for _ in range(5):
        client.renew()
    assert station.kinds() == ["lease_claim"]
    client._renewed -= 1.0
    client.renew()
    client.renew()
    assert station.kinds() == ["lease_claim", "lease_renew"]


def test_a_lease_that_was_lost_is_told_when_it_is_renewed(client, station):
    client.claim()
    station.time += 5.0
    client._renewed -= 1.0
    with pytest.raises(Refused, match="the station has no operator"):
        client.renew()


def test_a_lease_can_be_given_up(client, connect, station):
    client.claim()
    client.release()
    connect("ben").claim()
    assert station.lease.current(station.time).holder == "ben"


def test_what_was_decided_before_a_restart_is_stale(client, station):
    client.command("run")
    station.restart("boot-2")
    station.lease.claim("anna", 0, station.time)
    with pytest.raises(Refused, match="stale: it was decided before the runtime was restarted"):
        client._command("run", 2.0, epoch=1)
    assert client.command("run").status == "accepted"


def test_a_station_that_is_mute_is_an_unknown_outcome(client, station):
    client.claim()
    station.mute = True
    with pytest.raises(TransportError, match=r"no answer to status within 0.02 s: outcome unknown"):
        client.status(timeout=0.02)
    station.mute = False
    assert client.status()["boot"] == "boot-1"


def test_a_station_that_does_not_run_is_named(tmp_path):
    client = StationClient(tmp_path / "stations" / "bench-9")
    with pytest.raises(TransportError, match="station 'bench-9' is not running here"):
        client.status()


def test_a_station_that_moved_to_other_sockets_is_found_again(client, station):
    client.status()
    moved = CommandServer(station.context, station.folder, "commands")
    old, station._server = station._server, moved
    Endpoints(station.folder).write("coordinator", {"commands": moved.endpoint})
    assert client.status()["boot"] == "boot-1"
    old.close()


def test_waiting_ends_with_the_first_status_that_will_do_and_keeps_the_lease(client, station):
    client.claim()
    client._renewed -= 1.0
    assert client.wait(lambda status: "lease_renew" in station.kinds(), 2.0)["state"] == "ready"


def test_waiting_does_not_renew_a_lease_that_was_given_up(client, station):
    client.claim()
    client.release()
    client._renewed -= 1.0
    assert client.wait(lambda status: station.kinds().count("status") > 1, 2.0)["state"] == "ready"


def test_waiting_in_vain_says_what_the_station_was_doing(client):
    with pytest.raises(TransportError, match=r"not reached within 0.01 s; the station is ready: waiting"):
        client.wait(lambda status: False, 0.01)


def test_events_are_asked_for_by_number(client):
    assert client.events_since(41) == [{"number": 42}]


def test_the_live_streams_are_found_in_the_folder(client, station):
    publisher = Publisher(station.context, station.folder, "state", 16)
    Endpoints(station.folder).write("coordinator", {"commands": "", "state": publisher.endpoint})
    subscriber = client.subscribe("state")
    for _ in range(200):
        publisher.publish("state", {"sequence": 1})
        if content := subscriber.receive(0.01):
            break
    assert content == {"state": {"sequence": 1}}
    subscriber.close()


def test_the_estop_goes_to_the_guard_without_any_lease(client, station):
    guard = CommandServer(station.context, station.folder, "estop")
    Endpoints(station.folder).write("guard", {"estop": guard.endpoint})
    pressed = []

    def answer():
        assert guard.socket.poll(PATIENCE_MS)
        address, command = guard.receive()
        pressed.append(command)
        guard.answer(address, Ack(command.uuid, "done", "obeyed"))

    thread = threading.Thread(target=answer)
    thread.start()
    assert client.estop("arm too low").reason == "obeyed"
    thread.join()
    assert (pressed[0].kind, pressed[0].args, pressed[0].user) == ("estop", {"why": "arm too low"}, "anna")
    assert station.received == []


def test_an_estop_that_cannot_be_delivered_says_what_to_do(client):
    with pytest.raises(TransportError, match="USE THE HARDWARE STOP: station 'bench-1' is not running here"):
        client.estop("arm too low")


def test_without_a_name_a_terminal_is_named_after_its_user_and_machine(tmp_path):
    assert StationClient(tmp_path).holder.startswith("terminal:")
    assert "@" in StationClient(tmp_path).holder


def test_arguments_travel_with_their_command(client, station):
    ack = client.command("run", trial={"id": 7}, duration_s=20)
    assert ack.data["episode"] == "episode-7"
    assert station.received[-1].args == {"trial": {"id": 7}, "duration_s": 20}
    assert station.effects.done == [("begin_run", RunRequest(trial={"id": 7}, duration_s=20.0))]


def test_a_question_needs_no_lease_and_its_refusal_is_raised(client, station):
    assert client.query("aim", arm="left").data["joints"] == [1.0]
    with pytest.raises(Refused, match="no such arm"):
        client.query("aim")
    assert station.kinds() == ["aim", "aim"]
    assert station.lease.current(station.time) is None


def test_two_terminals_of_one_person_are_one_holder(connect, station):
    attending, other = connect("terminal:anna@bench"), connect("terminal:anna@bench")
    attending.command("run")
    other.command("halt")
    attending._renewed -= 1.0
    attending.renew()
    assert station.session.state is SessionState.HOLDING
