"""Demonstrations recorded over each transport, from robots in processes of their own, in real time."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import robots
from runtime.config import loader
from runtime.core.clock import MonotonicClock
from runtime.ipc.session_state import SessionState
from runtime.processes.lockstep import lockstep
from runtime.recording.reader import Episode, open_episode
from runtime.station.checks import check_deployment
from runtime.transports import ros1, ros2
from runtime.transports.ros import cdr, ros1_serialization
from runtime.transports.ros.messages import JointState, Wire
from runtime.transports.ros.middleware import SENSOR_QUALITY, Middleware, Topic
from tests.processes import PATIENCE_S
from tests.runtime.lockstep_station import column
from tests.runtime.ros_master import RosMaster, needs_ros1

pytestmark = pytest.mark.slow
SMALL = ("--width", "64", "--height", "48", "--lifeline")

Start = Callable[..., dict[str, Any]]


class SinceNow(MonotonicClock):
    """Real time, counted from the beginning as lockstep counts its own."""

    def __init__(self) -> None:
        self._begun = time.monotonic()

    def now(self) -> float:
        return super().now() - self._begun

    def sleep_until(self, deadline: float) -> None:
        super().sleep_until(deadline + self._begun)


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts `python -m module`, returns what its first line says; ends it with the test."""
    running: list[subprocess.Popen[bytes]] = []

    def begin(module: str, *arguments: str) -> dict[str, Any]:
        process = subprocess.Popen(
            [sys.executable, "-m", module, *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        running.append(process)
        assert process.stdout is not None
        said: dict[str, Any] = json.loads(process.stdout.readline())
        return said

    yield begin
    for process in running:
        assert process.stdin is not None
        process.stdin.close()
    for process in running:
        try:
            process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def demonstration(
    data: Path,
    monkeypatch: pytest.MonkeyPatch,
    robot: str,
    transport: dict[str, Any],
    collection: dict[str, Any],
) -> Episode:
    """Two seconds of one, from set-up to the file, by the very parts of a station in one process."""
    monkeypatch.setattr(lockstep, "VirtualClock", SinceNow)
    tree = {
        "station": "bench",
        "robot": robot,
        "data_dir": str(data),
        "task": "wave",
        "transport": {"detect_frozen": False, **transport},
        "collection": collection,
        "setup": {"home": False},
        "recording": {"min_free_bytes": 0},
        "safety": {"joint_age_s": PATIENCE_S, "picture_age_s": PATIENCE_S},
        "control": {"heartbeat_timeout_s": 10.0, "coordinator_timeout_s": 10.0},
    }
    station = lockstep.Lockstep(check_deployment(loader.resolve_deployment(tree, {}, "test")))
    session = station.coordinator.session
    try:
        station.connect()
        station.until(lambda: session.state is SessionState.IDLE, 30.0, "first observation")
        station.command("setup", collect=True)
        station.until(lambda: session.state is not SessionState.SETTING_UP, 30.0, "set-up")
        assert session.state is SessionState.READY, session.reason
        station.command("arm")
        station.command("run")
        begun = station.step
        station.until(lambda: station.step > begun + 60, 30.0, "demonstration")
        assert session.state is SessionState.RUNNING, session.reason
        station.command("label", result="success")
        station.command("stop")
        station.until(lambda: station.coordinator.snapshot()["collect"]["last"] is not None, 10.0, "the file")
        last = station.coordinator.snapshot()["collect"]["last"]
        assert last["result"] == "success"
        return open_episode(data / "episodes" / last["uuid"])
    finally:
        station.close()


def moved(episode: Episode) -> None:
    """It is a demonstration in which a person's actions moved the robot, with all its pictures."""
    assert episode.manifest["kind"] == "demonstration"
    assert episode.frames > 40
    led = column(episode.rows, "control_source") == "teleop"
    assert led.mean() > 0.8
    assert (column(episode.rows, "intervention") == led).all()
    action, state = (np.array(column(episode.rows, name).tolist())[led] for name in ("action", "qpos"))
    assert np.isfinite(action).all()
    assert np.ptp(action, axis=0).max() > 0.05
    assert np.ptp(state, axis=0).max() > 0.03
    assert set(episode.videos) == set(episode.manifest["cameras"])


def waving(start: Start, robot: str) -> dict[str, Any]:
    """A leader that waves as the node beside it does, which nobody commands."""
    node = start(
        *("runtime.simulation.node", "--robot", robot, "--obs-endpoint", "tcp://127.0.0.1:0"),
        *("--action-endpoint", "tcp://127.0.0.1:0", *SMALL),
    )
    leader = start(
        *("runtime.simulation.leader", "--robot", robot, "--behaviour", "gesture", "--lifeline"),
        *("--obs-endpoint", node["obs_endpoint"], "--endpoint", "tcp://127.0.0.1:0"),
    )
    ends = {"sub_endpoint": node["obs_endpoint"], "pub_endpoint": node["action_endpoint"]}
    return {"leader": {"kind": "zmq", "endpoint": leader["endpoint"]}, "node": ends}


class Waving:
    """Leader arms that publish on ROS topics, in any order of joints and under a name more than are wanted."""

    def __init__(self, robot: str, open_middleware: Callable[[], Middleware], wire: Wire) -> None:
        described = robots.load_robot(robot)
        self._home = described.poses["home"]
        self._groups = [group for group in described.groups if group.chain is not None]
        self.topics = {group.name: f"/leader/{group.name}" for group in self._groups}
        self._open, self._wire, self._ended = open_middleware, wire, threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Waving:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        middleware = self._open()
        say = {
            name: middleware.advertise(Topic(topic, "JointState", SENSOR_QUALITY))
            for name, topic in self.topics.items()
        }
        began = time.monotonic()
        while not self._ended.wait(0.02):
            for group in self._groups:
                position = self._home[group.slice].copy()
                position[:3] += 0.1 * np.sin(2.0 * (time.monotonic() - began))
                names = (*reversed(group.joints), "pedal")
                say[group.name](
                    self._wire.encode(JointState(time.time_ns(), "", names, np.append(position[::-1], 7.0)))
                )
        middleware.close()


def relayed(ways: dict[str, Any], mode: str = "absolute") -> dict[str, Any]:
    return {"source": "relay", "leader": ways["leader"], "mode": mode, "max_age_s": 2.0}


@pytest.mark.lab
def test_over_zmq_a_leader_is_relayed(tmp_path: Path, start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    ways = waving(start, "agilex_piper")
    transport = {"kind": "zmq", **ways["node"]}
    moved(demonstration(tmp_path, monkeypatch, "agilex_piper", transport, relayed(ways)))


@pytest.mark.lab
def test_over_zmq_a_node_that_drives_itself_is_recorded(
    tmp_path: Path, start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    ways = waving(start, "agilex_piper")
    transport = {"kind": "zmq", **ways["node"]}
    episode = demonstration(tmp_path, monkeypatch, "agilex_piper", transport, {"source": "node"})
    moved(episode)
    assert column(episode.rows, "eef_action_reported").mean() > 0.8


def led(kind: str, leader: Waving, **link: Any) -> dict[str, Any]:
    """Relayed from topics."""
    groups = {name: {"topic": topic} for name, topic in leader.topics.items()}
    leader_of = {"kind": kind, "groups": groups, **link}
    return {"source": "relay", "leader": leader_of, "mode": "relative", "max_age_s": 2.0}


@pytest.mark.lab
def test_over_ros_2_a_leader_is_relayed(
    tmp_path: Path, start: Start, monkeypatch: pytest.MonkeyPatch, domain: int
) -> None:
    pytest.importorskip("cyclonedds", reason="the package cyclonedds (extra ros2) is not installed")
    start("runtime.simulation.ros2_node", "--robot", "r1_lite", "--domain", str(domain), *SMALL)
    link = ros2.Link(domain=domain)
    with Waving("r1_lite", lambda: ros2.middleware(link, "leader"), cdr) as leader:
        collection = led("ros2", leader, domain=domain)
        transport = {"kind": "ros2", "domain": domain}
        moved(demonstration(tmp_path, monkeypatch, "r1_lite", transport, collection))


@pytest.mark.lab
@needs_ros1
def test_over_ros_1_a_leader_is_relayed(
    tmp_path: Path, start: Start, monkeypatch: pytest.MonkeyPatch, ros_master: RosMaster
) -> None:
    start("runtime.simulation.ros1_node", "--robot", "agilex_piper", "--master", ros_master.uri, *SMALL)
    link = ros1.Link(master=ros_master.uri)
    with Waving("agilex_piper", lambda: ros1.middleware(link, "leader"), ros1_serialization) as leader:
        collection = led("ros1", leader, master=ros_master.uri)
        transport = {"kind": "ros1", "master": ros_master.uri}
        moved(demonstration(tmp_path, monkeypatch, "agilex_piper", transport, collection))
