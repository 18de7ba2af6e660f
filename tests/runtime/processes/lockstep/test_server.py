"""A lockstep station behind its sockets: when its time passes, and that who stops it is not kept waiting."""

from __future__ import annotations

import os
import threading
import uuid
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq

from runtime.core.clock import VirtualClock
from runtime.core.errors import SetupError
from runtime.core.types import ActionChunk
from runtime.ipc.bus import Endpoints, Subscriber, TransportError
from runtime.ipc.endpoints import account_name
from runtime.ipc.estop_latch import Latch
from runtime.ipc.messages import Ack, Command, decode, encode
from runtime.ipc.session_state import SessionState
from runtime.processes.lockstep import server as served_lockstep
from runtime.processes.lockstep.server import ServedLockstep
from runtime.processes.media.recorder import ClosedEpisode
from runtime.processes.media.unclosed_episodes import Close, in_background
from runtime.recording.reader import Episode, open_episode
from tests.processes import PATIENCE_S
from tests.runtime.lockstep_station import STANDS, StubPolicy, StubRobot, Stubs, column, stubbed

TURNS = 5000


class Client:
    """A station and who commands it, turn by turn in one thread; `people` is the time that they have."""

    def __init__(
        self, made: Stubs, over: Callable[[bool], str] = lambda running: "", paced: bool = False
    ) -> None:
        made.built.clear()
        self.people = VirtualClock(100.0)
        self._waits = 1.0 / made.spec.rate if paced else 0.0
        self.station = ServedLockstep(made.spec, VirtualClock(), over, self.people, made.peers, paced)
        self.station.connect()
        self.robot: StubRobot = made.built["robot"]
        self.policy: StubPolicy = made.built["policy"]
        self._context: zmq.Context[Any] = zmq.Context()
        self._endpoints = Endpoints(made.spec.deployment.station_dir)
        self._coordinator = self._connected("coordinator", "commands")
        self._guard = self._connected("guard", "estop")
        self.until(SessionState.IDLE)
        assert self.ask("lease_claim", epoch=0).status == "accepted"

    def _connected(self, process: str, key: str) -> zmq.Socket[Any]:
        socket = self._context.socket(zmq.DEALER)
        socket.connect(self._endpoints.read(process)[key])
        return socket

    @property
    def state(self) -> SessionState:
        return self.station.coordinator.session.state

    @property
    def reason(self) -> str:
        return self.station.coordinator.session.reason

    def ask(self, kind: str, epoch: int | None = None, guard: bool = False, **arguments: Any) -> Ack:
        """The answer over the socket, the station turning meanwhile."""
        main, socket = self.station.coordinator, self._guard if guard else self._coordinator
        command = Command(
            str(uuid.uuid4()),
            kind,
            arguments,
            user="ada",
            holder="ada",
            epoch=main.lease.epoch if epoch is None else epoch,
            boot=main.boot,
            sequence=main.session.sequence,
            valid_until=self.people.now() + 2.0,
        )
        socket.send(encode(command))
        for _ in range(TURNS):
            self.station.poll()
            if socket.poll(1):
                answer = decode(socket.recv())
                assert isinstance(answer, Ack)
                return answer
        raise AssertionError(f"no answer to {kind}")

    def turn(self, count: int = 1, seconds: float = 0.0) -> int:
        """Turns that take `seconds` each of the people's time; how many ticks were in them."""
        before = self.station.step
        for _ in range(count):
            self.people.advance(seconds)
            self.station.poll()
        return self.station.step - before

    def until(self, *states: SessionState) -> None:
        for _ in range(TURNS):
            if self.state in states:
                return
            self.people.advance(self._waits)
            self.station.poll()
        raise AssertionError(f"never {states}; {self.state}: {self.reason}")

    def ready(self) -> Client:
        self.accepted("setup")
        self.until(SessionState.READY)
        return self

    def running(self, ticks: int = 20) -> Client:
        self.accepted("run")
        begun = self.station.step
        while self.station.step < begun + ticks:
            self.people.advance(self._waits)
            self.station.poll()
        return self

    def episode(self) -> Episode:
        """The last episode, once it is closed."""
        for _ in range(TURNS):
            if found := self.station.coordinator.runs.last_episode:
                return open_episode(Path(found["path"]))
            self.station.poll()
        raise AssertionError("no episode is closed")

    def hangs(self) -> threading.Event:
        """From now on the policy answers when the event is set; returns when it is asked."""
        infer, asked, gate = self.policy.infer, threading.Event(), threading.Event()

        def hanging(*given: Any) -> ActionChunk:
            asked.set()
            gate.wait(PATIENCE_S)
            return infer(*given)

        self.policy.infer = hanging  # type: ignore[method-assign]
        while not asked.is_set():
            self.station.poll()
        return gate

    def accepted(self, kind: str, **arguments: Any) -> None:
        answer = self.ask(kind, **arguments)
        assert answer.status == "accepted", answer.reason

    def close(self) -> None:
        self.station.close()
        self._context.destroy(linger=0)


@pytest.fixture
def made(tmp_path: Path) -> Stubs:
    return stubbed(tmp_path, recording={"min_free_bytes": 0, "export": False})


@pytest.fixture
def client(made: Stubs) -> Iterator[Client]:
    client = Client(made)
    yield client
    client.close()


# --- when time passes --------------------------------------------------------------------------------------


def test_time_stands_still_before_and_after_a_set_up_and_its_station_is_seen_all_the_while(
    client: Client,
) -> None:
    assert client.turn(50, 0.1) == 0
    client.ready()
    endpoints = Endpoints(client.station.spec.deployment.station_dir)
    context: zmq.Context[Any] = zmq.Context()
    states = Subscriber(context, endpoints.read("coordinator")["state"], "state")
    pictures = Subscriber(context, endpoints.read("media")["cameras"], "camera/")
    seen: set[str] = set()
    for _ in range(200):
        assert client.turn(1, 0.1) == 0
        seen |= {*states.receive(0.01), *pictures.receive(0.01)}
        client.ask("lease_renew")
        if len(seen) == 4:
            break
    assert seen == {"state", *(f"camera/{camera}" for camera in client.robot.cameras)}
    for reader in (states, pictures):
        reader.close()
    context.destroy(linger=0)


def test_a_run_goes_on_without_waiting_for_anybodys_time(client: Client) -> None:
    client.ready().running(100)  # not a moment of theirs
    assert client.state is SessionState.RUNNING


def test_what_waits_for_a_person_goes_no_faster_than_they_live(client: Client) -> None:
    client.ready().accepted("run", mode="manual")
    client.turn(5, 1.0)
    assert client.turn(100) == 0
    assert client.turn(60, 1 / 60) == pytest.approx(30, abs=2)


def test_what_a_person_moves_in_between_takes_its_time_and_then_it_stands_still(client: Client) -> None:
    client.ready()
    before = client.robot.position.copy()
    client.accepted("gripper", arm="left_arm", action="close")
    for _ in range(10):
        client.turn(10, 1 / 30)
        client.ask("lease_renew")
    assert not np.allclose(client.robot.position, before)
    assert client.turn(50, 0.01) == 0


def test_a_policy_that_takes_long_changes_nothing_of_what_is_recorded(tmp_path: Path) -> None:
    said = []
    for name, waits in (("quick", 0.0), ("slow", 0.02)):
        made = stubbed(tmp_path / name, delay=3, recording={"min_free_bytes": 0, "export": False})
        client = Client(made)
        infer = client.policy.infer

        def slowly(*given: Any, infer: Any = infer, waits: float = waits) -> ActionChunk:
            threading.Event().wait(waits)
            chunk = infer(*given)
            return ActionChunk(
                chunk.actions, timing={"policy.infer_ms": 5000.0}
            )  # what it says has no effect

        client.policy.infer = slowly  # type: ignore[method-assign]
        client.turn(int(1000 * waits), 0.01)  # an operator who is slower too
        client.ready()
        client.turn(int(1000 * waits), 0.01)
        client.running(60)
        client.accepted("halt")
        client.turn(2, 1.0)
        client.accepted("stop")
        episode = client.episode()
        asked = [row["observation_step"] for row in episode.raw.to_pylist()]
        said.append((client.robot.sent[:60], asked[:12], column(episode.rows, "time")[:55]))
        delays = list(client.station.coordinator.inference.metrics.delays)
        assert delays[2:]
        assert set(delays[2:]) == {3}  # whatever they really took
        figures = client.station.coordinator.inference.metrics.figures()
        assert figures["latency_ms"]["max"] == pytest.approx(100.0)
        assert figures["wall_latency_ms"]["p50"] >= 1000 * waits
        client.close()
    for quick, slow in zip(*said, strict=True):
        assert np.array_equal(quick, slow)


def test_no_tick_more_passes_after_a_run(client: Client) -> None:
    client.ready().accepted("run", duration_s=1.0)
    client.until(SessionState.READY)
    while client.station._asking.start_waiting():  # the policy is told that the rollout is over
        pass
    assert client.turn(20, 0.1) == 0


def test_who_sets_up_while_a_recording_is_closed_finds_the_same_as_who_comes_later(
    made: Stubs, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate = threading.Event()

    def slowly(close: Close) -> Future[ClosedEpisode]:
        def waiting() -> ClosedEpisode:
            gate.wait(PATIENCE_S)
            return close()

        return in_background(waiting)

    monkeypatch.setattr(served_lockstep, "in_background", slowly)
    client = Client(made, lambda running: "over" if running and client.station.step > 60 else "")
    client.ready().accepted("run")
    client.until(SessionState.READY)
    client.accepted("setup")
    assert client.turn(20) == 0
    gate.set()
    ticks = 0
    while client.station.media.closing:
        ticks += client.turn()
    assert ticks == 0
    report = client.station.coordinator.inbox.media_report
    assert (report.recording, report.time) == ("", client.station.clock.now())  # before the first tick of it
    client.close()


def test_a_recording_of_its_own_takes_its_time(client: Client) -> None:
    client.ready().accepted("record_start")
    assert client.turn(60, 1 / 60) == pytest.approx(30, abs=2)
    client.accepted("record_stop")
    client.turn(2, 0.1)
    assert client.episode().frames > 20
    assert client.turn(20, 0.1) == 0


def test_a_run_ends_where_its_bench_says_so_and_its_episode_is_whole(made: Stubs) -> None:
    asked = []

    def over(running: bool) -> str:
        asked.append(running)
        return "the block lies there" if asked.count(True) == 40 else ""

    client = Client(made, over)
    client.ready().accepted("run")
    client.until(SessionState.READY)
    assert client.reason == "the block lies there"
    outcome = client.episode().outcome
    assert outcome is not None
    assert outcome["status"] == "finished"
    client.turn(3)
    assert outcome["control"]["scheduling"] == "lockstep"
    assert client.station.coordinator.snapshot()["recording"]["uuid"] == ""
    again = client.station.step
    client.running(20)  # at once, and as whole
    assert client.state is SessionState.RUNNING
    assert client.station.step >= again + 20
    client.close()


# --- who stops it ------------------------------------------------------------------------------------------


@pytest.mark.exhaustive
def test_a_lease_that_is_not_renewed_in_the_peoples_time_holds_the_robot(client: Client) -> None:
    client.ready().running(200)  # more than a lease lasts, of its own time
    assert client.state is SessionState.RUNNING
    client.turn(1, 6.0)
    client.turn(5)
    assert client.state is SessionState.HOLDING
    assert "the lease was not renewed" in client.reason
    assert client.ask("resume").reason == "the station has no operator: take it first"


def test_a_lease_ends_while_time_stands_still_too(client: Client) -> None:
    client.ready()
    client.turn(3, 3.0)
    assert client.station.coordinator.snapshot()["lease"]["holder"] == ""


def test_a_command_is_void_after_its_time_whatever_the_stations_own_is(client: Client) -> None:
    client.ready().running(100)
    client.people.advance(2.0)
    client.accepted("halt")
    assert client.state is SessionState.HOLDING


@pytest.mark.parametrize("during", ["idle", "run", "call"])
def test_the_e_stop_is_obeyed_at_once(client: Client, during: str) -> None:
    gate = threading.Event()
    if during != "idle":
        client.ready().running()
    if during == "call":
        gate = client.hangs()
        assert client.turn(20) == 0
    answer = client.ask("estop", guard=True, why="smoke")
    assert (answer.status, answer.data["station"], answer.data["latched"]) == ("done", "bench", "anew")
    gate.set()
    client.turn(20, 1 / 30)
    assert client.state is SessionState.FAULTED
    assert f"account:{account_name(os.getuid())}: smoke" in client.reason
    assert Latch(client.station.spec.deployment.station_dir).read() is not None
    client.accepted("release")
    client.turn(20, 1 / 30)
    assert client.state is SessionState.IDLE
    assert Latch(client.station.spec.deployment.station_dir).read() is None


def test_a_policy_that_hangs_keeps_nobody_from_stopping(client: Client) -> None:
    gate = client.ready().running().hangs()
    assert client.turn(20) == 0
    client.accepted("stop")
    assert client.state is SessionState.READY
    gate.set()


# --- a station like any other ------------------------------------------------------------------------------


def test_a_station_is_of_one_process(made: Stubs, client: Client) -> None:
    with pytest.raises(SetupError, match="station 'bench' is already running"):
        ServedLockstep(made.spec, VirtualClock(), peers=made.peers)


def test_there_is_no_control_channel(tmp_path: Path) -> None:
    made = stubbed(tmp_path, control_channel={"enabled": True})
    with pytest.raises(SetupError, match=r"control_channel\.enabled = true in lockstep, which has none"):
        ServedLockstep(made.spec, VirtualClock(), peers=made.peers)


def test_when_it_ends_its_episode_is_closed_and_nothing_is_found_of_it(made: Stubs) -> None:
    client = Client(made)
    client.ready().running()
    client.close()
    (folder,) = made.spec.deployment.episodes_dir.iterdir()
    outcome = open_episode(folder).outcome
    assert outcome is not None
    assert outcome["status"] == "interrupted"
    with pytest.raises(TransportError, match="is not running here"):
        Endpoints(made.spec.deployment.station_dir).read("coordinator")
    assert client.robot.sent[-1] == pytest.approx(STANDS, abs=0.2)
    Client(made).close()


@pytest.mark.exhaustive
def test_a_paced_station_is_no_faster_than_life_whatever_it_does(tmp_path: Path) -> None:
    client = Client(stubbed(tmp_path), paced=True)
    period = 1.0 / client.station.spec.rate
    for begin in (lambda: None, client.ready, client.running):
        begin()
        assert client.turn(50) <= 1
        assert 45 <= client.turn(50, period) <= 50  # time stands still while the policy is asked
    client.close()


def test_presses_of_the_e_stop_are_obeyed_at_once_and_hurry_no_paced_time(tmp_path: Path) -> None:
    client = Client(stubbed(tmp_path), paced=True).ready().running()
    period, begun = 1.0 / client.station.spec.rate, client.station.step
    client.turn(1, period)
    for _ in range(10):
        assert client.ask("estop", guard=True, why="again").status == "done"  # in no time of people's
    ahead = client.station.step - begun
    assert client.turn(50, period) <= 50 - ahead + 2
    client.close()
