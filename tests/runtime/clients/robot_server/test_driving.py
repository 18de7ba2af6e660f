"""A whole station driven by another program, through its robot server and the client that is given to others."""

from __future__ import annotations

import argparse
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from itertools import count
from pathlib import Path
from typing import Any

import msgpack  # type: ignore[import-untyped]
import numpy as np
import pytest
import zmq
from websockets.exceptions import InvalidStatus
from websockets.frames import Frame, Opcode
from websockets.sync.client import connect

from runtime.clients.listener import get_or_create_token
from runtime.clients.robot_server import session as sessions
from runtime.clients.robot_server.__main__ import TOKEN_FILE, JointsWatch, serve
from runtime.clients.robot_server.exchange import RowExchange
from runtime.clients.robot_server.server import RobotServer
from runtime.clients.robot_server.session import DriveSession
from runtime.core.errors import ConfigurationError
from runtime.integrations.evaweb_robot.evaweb_robot import Station, StationError
from runtime.ipc.bus import Endpoints, Publisher
from runtime.ipc.session_state import SessionState
from runtime.recording.reader import open_episode
from tests.processes import PATIENCE_S, eventually
from tests.runtime.clients.channel.bench import Bench, _Patient
from tests.runtime.lockstep_station import DIM, MOVED, STANDS

TOKEN = "secret"


class Served(Bench):
    """A station whose robot server is at `url`."""

    def __init__(self, folder: Path, silence_s: float = 600.0, **settings: Any) -> None:
        self._numbers = count()
        super().__init__(folder, real="external", **settings)
        self.server = RobotServer(TOKEN, self._session, dict, silence_s)
        self.url = f"ws://127.0.0.1:{self.server.open('127.0.0.1', 0)}/?token={TOKEN}"

    def _session(self, program: str) -> DriveSession:
        number = next(self._numbers)
        client = _Patient(self, f"robot:{program}#{number}")
        return DriveSession(client, RowExchange(self.context, self.folder, f"rows{number}"), program)

    def close(self) -> None:
        self.server.close()
        super().close()


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sessions, "_PATIENCE_S", PATIENCE_S)


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Served]:
    made = Served(tmp_path)
    yield made
    made.close()


@pytest.fixture
def program(bench: Served) -> Iterator[Station]:
    with Station(bench.url, program="theirs") as made:
        yield made


def refused(call: Callable[[], Any]) -> StationError:
    """The error with which a call ends, as soon as it does."""
    found: list[StationError] = []

    def is_refused() -> bool:
        try:
            call()
        except StationError as error:
            found.append(error)
        return bool(found)

    eventually(is_refused, "it is refused")
    return found[0]


def test_a_program_drives_and_its_run_is_an_episode_with_what_it_sent_and_what_was_executed(
    bench: Served, program: Station
) -> None:
    robot = program.describe()
    assert (robot.robot, len(robot.joint_names), robot.has_bench) == ("agilex_piper", DIM, False)
    assert set(robot.cameras) == {"cam_high", "cam_left_wrist", "cam_right_wrist"}
    assert np.isfinite([*robot.lower, *robot.upper, *robot.velocity, *robot.home]).all()
    episode = program.begin("fold the cloth")
    first = program.observe()
    assert first.task == "fold the cloth"
    assert {camera: picture.shape[:2] for camera, picture in first.pictures.items()} == robot.cameras
    np.testing.assert_allclose(first.joints, STANDS, atol=1e-6)
    row = STANDS.astype(np.float32)
    row[list(MOVED)] += 0.3
    program.act(row)
    eventually(lambda: np.allclose(program.observe().joints, row, atol=1e-3), "the robot is there")
    assert program.observe().step > first.step
    assert program.end() == episode
    recorded = open_episode(Path(bench.station.coordinator.runs.last_episode["path"]))
    assert recorded.manifest["uuid"] == episode
    assert recorded.manifest["policy"]["kind"] == "external"
    assert recorded.manifest["policy"]["name"] == "theirs"
    sent = np.array(recorded.ticks["executed"].to_pylist())
    np.testing.assert_allclose(sent[-1], row, atol=1e-3)
    assert np.abs(np.diff(sent[:, MOVED[0]])).max() < 0.3  # on a limited path, however far the row was


@pytest.mark.parametrize(
    ("driver", "kind", "source"), [("policy", "rollout", "policy"), ("person", "demonstration", "teleop")]
)
def test_what_a_person_drives_is_a_demonstration(
    bench: Served, program: Station, driver: str, kind: str, source: str
) -> None:
    program.begin(driver=driver)
    row = program.observe().joints.copy()
    row[list(MOVED)] += 0.1
    program.act(row)
    eventually(lambda: np.allclose(program.observe().joints, row, atol=1e-3), "the robot is there")
    program.end()
    recorded = open_episode(Path(bench.station.coordinator.runs.last_episode["path"]))
    assert recorded.manifest["kind"] == kind
    assert {"policy", "teleop"}.intersection(recorded.ticks["control_source"].to_pylist()) == {source}


def test_the_estop_ends_its_loop_for_good(bench: Served, program: Station) -> None:
    program.begin()
    bench.station.guard.press("anna", "a hand is in the way")
    error = refused(program.observe)
    assert error.is_over
    assert not error.is_stopped
    assert "a hand is in the way" in str(error)
    for call in (lambda: program.act(STANDS), program.observe):
        assert "a hand is in the way" in str(refused(call))
    assert "release" in str(refused(program.begin))


def test_a_stop_by_its_limit_ends_the_run_with_a_station_that_is_ready_for_another(
    bench: Served, program: Station
) -> None:
    program.begin(duration_s=0.5)
    error = refused(program.observe)
    assert (error.is_over, error.is_stopped) == (True, True)
    assert "ready" in str(error)
    assert program.begin() != ""
    program.observe()


def test_any_operator_may_stop_it_without_its_lease(bench: Served, program: Station) -> None:
    program.begin()
    _Patient(bench, "terminal:anna").command("stop")
    error = refused(program.observe)
    assert (error.is_over, error.is_stopped) == (True, True)


def test_a_lost_lease_is_an_error_of_its_next_call(bench: Served, program: Station) -> None:
    program.begin()
    lease, now = bench.station.coordinator.lease, bench.station.clock.now
    with bench.lock:
        held = lease.current(now())
        assert held is not None
        lease.release(held.holder, held.epoch, now())
        lease.claim("console:anna", held.epoch + 1, now())
    assert "console:anna" in str(refused(program.observe))
    assert refused(lambda: program.act(STANDS)).is_over


@pytest.mark.parametrize(
    ("row", "why"),
    [
        (np.zeros(3), r"a row of float32 \[3\]; expected 14 floating-point numbers"),
        (np.full(DIM, np.nan), "finite numbers"),
        (np.full(DIM, 1e300), "finite numbers"),
    ],
)
def test_a_row_that_does_not_fit_is_refused_and_the_run_goes_on(
    bench: Served, program: Station, row: np.ndarray, why: str
) -> None:
    program.begin()
    with pytest.raises(StationError, match=why) as refusal:
        program.act(row)
    assert not refusal.value.is_over
    program.act(STANDS)


def test_nothing_is_driven_without_a_run(bench: Served, program: Station) -> None:
    program.describe()
    for call in (program.observe, lambda: program.act(STANDS)):
        assert refused(call).is_over
    assert program.end() == ""
    assert bench.station.coordinator.lease.current(bench.station.clock.now()) is None


def test_an_interrupted_request_leaves_no_answer_to_another(
    bench: Served, program: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    program.begin()

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    connection = program._connection
    assert connection is not None
    monkeypatch.setattr(connection, "recv", interrupted)
    with pytest.raises(KeyboardInterrupt):
        program.observe()
    assert not program.is_connected
    bench.reach(SessionState.READY)
    assert "begin one first" in str(refused(program.observe))


def test_a_program_that_reads_no_answer_loses_its_run_and_its_lease(
    bench: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sessions, "_READING_S", 0.1)
    request = msgpack.packb({"do": "observe"})
    with connect(bench.url, max_size=None) as frozen:
        frozen.recv_bufsize = 1
        frozen.send(msgpack.packb({"do": "begin", "program": "frozen"}))
        assert b"episode" in frozen.recv(PATIENCE_S)  # type: ignore[operator]
        frozen.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)
        frozen.protocol_mutex.acquire()  # its thread reads nothing from here on
        try:
            frozen.socket.setblocking(True)
            for _ in range(2000):
                frozen.socket.sendall(Frame(Opcode.BINARY, request).serialize(mask=True))
            bench.reach(SessionState.READY)
            lease = bench.station.coordinator.lease
            eventually(lambda: lease.current(bench.station.clock.now()) is None, "no lease is left")
        finally:
            frozen.protocol_mutex.release()


def test_one_session_follows_another_without_waiting(bench: Served) -> None:
    for _ in range(3):
        with Station(bench.url, program="loop") as program:
            program.begin()
            program.observe()
    bench.reach(SessionState.READY)


def test_another_program_is_refused_with_the_name_of_the_holder(bench: Served, program: Station) -> None:
    program.begin()
    with Station(bench.url, program="others") as other:
        assert "robot:theirs#0" in str(refused(other.begin))
    program.observe()


def test_a_program_that_has_gone_leaves_no_run_and_no_lease(bench: Served, program: Station) -> None:
    program.begin()
    program.observe()
    program.close()
    bench.reach(SessionState.READY)
    eventually(
        lambda: bench.station.coordinator.lease.current(bench.station.clock.now()) is None, "no lease is left"
    )
    assert "begin one first" in str(refused(program.observe))  # on another connection


def test_a_program_that_falls_silent_loses_its_run(tmp_path: Path) -> None:
    with closing(Served(tmp_path, silence_s=0.2)) as bench, Station(bench.url) as program:
        program.begin()
        bench.reach(SessionState.RUNNING)
        bench.reach(SessionState.READY)
        error = refused(program.observe)
        assert "nothing was sent for 0.2 s" in str(error)
        assert error.is_over


def test_the_end_of_the_robot_server_ends_the_run(tmp_path: Path) -> None:
    with closing(Served(tmp_path)) as bench, Station(bench.url) as program:
        program.begin()
        bench.server.close()
        bench.reach(SessionState.READY)
        assert refused(program.observe).is_over


@pytest.mark.parametrize("setup", [{"home": True}])
def test_a_program_that_goes_during_the_set_up_begins_no_run(tmp_path: Path, setup: dict[str, Any]) -> None:
    with closing(Served(tmp_path, setup=setup)) as bench:
        bench.station.robot.blocked = True  # it never arrives
        bench.station.robot.position = STANDS + 0.2
        with Station(bench.url) as program:
            beginning = threading.Thread(target=lambda: refused(program.begin))
            beginning.start()
            bench.reach(SessionState.SETTING_UP)
            program.close()
            beginning.join(PATIENCE_S)
        eventually(lambda: bench.station.state is not SessionState.SETTING_UP, "the set-up is cancelled")
        assert bench.station.coordinator.runs.last_episode == {}


@pytest.mark.parametrize(
    ("address", "headers", "code"),
    [
        ("/?token=wrong", {}, 401),
        ("/", {}, 401),
        (f"/?token={TOKEN}", {"Origin": "https://lab.example.org"}, 403),
    ],
)
def test_who_may_connect(bench: Served, address: str, headers: dict[str, str], code: int) -> None:
    with pytest.raises(InvalidStatus) as refusal:
        connect(bench.url.partition("/?")[0] + address, additional_headers=headers)
    assert refusal.value.response.status_code == code


@pytest.mark.parametrize(
    ("payload", "why"),
    [
        ("text", "a text frame"),
        (b"\xc1", "not one msgpack message"),
        (b"\x01", "expected a map"),
        (b"\x81\xa2do\xa3fly", "request 'fly'; allowed: describe"),
        (b"\x82\xa2do\xa5begin\xa4seed\xa1x", "seed = 'x'"),
        (b"\x82\xa2do\xa5begin\xa6driver\xa1x", "driver = 'x'; allowed: policy, person"),
        (b"\x82\xa2do\xa8describe\xa7program\xa3a\nb", "program = 'a\\nb'"),
    ],
    ids=["text", "garbage", "number", "unknown", "seed", "driver", "program"],
)
def test_a_request_that_cannot_be_used_is_named(bench: Served, payload: str | bytes, why: str) -> None:
    with connect(bench.url) as program:
        program.send(payload)
        assert why.encode() in program.recv(PATIENCE_S)  # type: ignore[operator]


def test_others_watch_what_the_station_publishes(tmp_path: Path) -> None:
    context: zmq.Context[Any] = zmq.Context.instance()
    folder = tmp_path / "stations" / "bench"
    folder.mkdir(parents=True)
    publisher = Publisher(context, folder, "state", 64)
    Endpoints(folder).write("coordinator", {"state": publisher.endpoint})
    watch, ended = JointsWatch(context, folder), threading.Event()
    vectors = {
        name: np.array([float(n), np.nan], np.float32)
        for n, name in enumerate(["measured", "commanded", "planned"])
    }

    def publish() -> None:
        while not ended.wait(0.01):
            publisher.poll_subscriptions()
            publisher.publish("joints", {**vectors, "engaged": True})

    publishing = threading.Thread(target=publish)
    publishing.start()
    try:
        joints = watch.read()
        assert [float(joints[name][0]) for name in vectors] == [0.0, 1.0, 2.0]
    finally:
        watch.close()
        ended.set()
        publishing.join(PATIENCE_S)
        publisher.close()


def test_the_command_serves_at_an_address_with_a_token_of_this_account(tmp_path: Path) -> None:
    folder = tmp_path / "stations" / "bench"
    options = argparse.Namespace(host="127.0.0.1", port=0, certificate=None, key=None, silence_s=60.0)
    ended, found = threading.Event(), []
    server = threading.Thread(target=serve, args=(folder, options, ended.is_set, found.append))
    server.start()
    try:
        address = eventually(lambda: found, "the address")[0]
        assert address.endswith(f"/?token={get_or_create_token(folder, TOKEN_FILE)}")
        assert (folder / TOKEN_FILE).stat().st_mode & 0o777 == 0o600
        (folder / "emptied.token").touch()
        assert len(get_or_create_token(folder, "emptied.token")) == 32
        (folder / TOKEN_FILE).chmod(0o644)
        with pytest.raises(ConfigurationError, match="can be read by other accounts"):
            get_or_create_token(folder, TOKEN_FILE)
        (folder / TOKEN_FILE).chmod(0o600)
        with Station(address) as program:
            assert "bench" in str(refused(program.describe))  # no such station runs
    finally:
        ended.set()
        server.join(PATIENCE_S)
    options.host = "0.0.0.0"
    with pytest.raises(ConfigurationError, match="needs --certificate"):
        serve(folder, options, ended.is_set, found.append)


def test_a_client_without_an_address_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("EVAWEB_ROBOT_URL", raising=False)
    with pytest.raises(StationError, match="EVAWEB_ROBOT_URL"):
        Station()
    with pytest.raises(StationError, match=r"ws://127\.0\.0\.1:1/: describe: .*refused") as unreachable:
        Station("ws://127.0.0.1:1/?token=hidden").describe()
    with pytest.raises(StationError, match="begins with ws://") as unusable:
        Station("http://127.0.0.1:1/?token=hidden")
    assert "hidden" not in f"{unreachable.value} {unusable.value}"
