"""How the wires benchmark counts, paces, reads its pictures back, and what its figures are called."""

from __future__ import annotations

import socket
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import robots
from benchmarks import wires, wires_cases, wires_policies, wires_transports
from benchmarks.wires_receiver import Receiving, source
from benchmarks.wires_recording import record
from benchmarks.wires_relay import Relay
from benchmarks.wires_sender import Pace
from runtime.core.clock import VirtualClock
from runtime.core.errors import SetupError
from runtime.core.plugins import variants
from runtime.simulation.bench.numbered_frames import Scene, frame_number
from runtime.standins import camera_server
from tests.processes import PATIENCE_S

PIPER = robots.load_robot("agilex_piper")
SCENE = Scene(PIPER, 480, 640)


class Ticking:
    """A clock that goes on by a second each time it is asked."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        self.now += 1.0
        return self.now


def test_clients_are_asked_in_turn_and_who_was_first_is_last_the_next_time() -> None:
    asked: list[str] = []
    found = wires_policies.in_turn([lambda: asked.append("a"), lambda: asked.append("b")], 12.0, Ticking())
    counted = asked[2 * wires_policies.WARM :]
    assert counted[:4] == ["a", "b", "b", "a"]
    assert [len(one.round_trips) for one in found] == [counted.count("a"), counted.count("b")]
    assert found[0].row()["round_trip_ms"] == {"p50": 1000.0, "p99": 1000.0}
    assert found[0].row()["cpu_ms"] >= 0.0


def test_rounds_are_joined_before_percentiles_are_taken() -> None:
    rounds = [wires_policies.Timed([0.001] * 3, [0.002] * 3), wires_policies.Timed([0.003], [0.006])]
    joined = wires_policies.Timed.joined(rounds)
    assert joined.median == 0.001
    assert joined.row()["cpu_ms"] == pytest.approx(3.0)


def test_every_protocol_is_shown_three_pictures_and_fourteen_joints() -> None:
    names = [protocol.name for protocol in wires_policies.protocols(PIPER)]
    assert names == ["openpi", "roboarena", "starvla", "xpolicylab", "gr00t", "lerobot"]
    assert set(names) <= variants("runtime.policies").keys()
    shown = wires_policies.observation(PIPER)
    assert [picture.shape for picture in shown.pictures.values()] == [(224, 224, 3)] * 3
    assert shown.qpos.shape == (14,)


def test_a_relay_counts_the_bytes_of_each_way_and_leaves_no_thread() -> None:
    before = set(threading.enumerate())
    with socket.create_server(("127.0.0.1", 0)) as listening, Relay(listening.getsockname()[1]) as relay:
        client = socket.create_connection(("127.0.0.1", relay.port))
        server, _ = listening.accept()
        client.settimeout(PATIENCE_S)
        server.settimeout(PATIENCE_S)
        with client, server:
            client.sendall(b"x" * 1000)
            assert len(server.recv(1000, socket.MSG_WAITALL)) == 1000
            server.sendall(b"y" * 30)
            assert client.recv(30, socket.MSG_WAITALL) == b"y" * 30
            assert relay.settled() == (1000, 30)
    assert set(threading.enumerate()) <= before


class Arrivals:
    """How many pictures have arrived, as a virtual clock goes on: one every `every` seconds, at most `most`."""

    def __init__(self, clock: VirtualClock, every: float, most: float = np.inf) -> None:
        self._clock, self._every, self._most = clock, every, most

    def __call__(self) -> int:
        return int(min(self._clock.now() / self._every + 1e-9, self._most))


def sending(pace: Pace, clock: VirtualClock, count: int) -> list[float]:
    times = []
    for _ in range(count):
        pace.wait()
        times.append(clock.now())
    return times


def test_a_hurried_sender_is_a_few_pictures_ahead_and_no_more() -> None:
    clock = VirtualClock()
    times = sending(Pace(Arrivals(clock, 0.01), clock), clock, 20)
    assert times[:4] == [0.0] * 4
    for number, time in enumerate(times[4:], 1):
        assert time == pytest.approx(0.01 * number, abs=0.001)


def test_a_hurried_sender_gives_up_what_does_not_arrive() -> None:
    clock = VirtualClock()
    times = sending(Pace(Arrivals(clock, 0.01, most=0), clock, patience=0.05), clock, 9)
    assert times[4] == pytest.approx(0.05, abs=0.001)
    assert times[8] == pytest.approx(0.1, abs=0.002)


@given(st.integers(0, 2**16))
def test_a_pictures_number_is_in_what_a_tick_keeps_of_it(number: int) -> None:
    for picture in SCENE.draw(number, 0.0, PIPER.poses["home"]).values():
        assert (
            wires_transports.strip_number(wires_transports.number_marks(picture))
            == frame_number(picture)
            == number
        )


@given(st.integers(0, 400))
def test_a_cameras_picture_is_the_newest_that_left_with_its_bar(number: int) -> None:
    sent = [n / 30 for n in range(600)]
    marks = wires_transports.number_marks(camera_server.picture(number, 640, 480))
    assert wires_transports.bar_birth(marks, sent[number] + 0.02, sent) == sent[number]


def test_the_age_is_that_of_the_oldest_picture_and_unknown_while_one_is_overwritten() -> None:
    drawn = {
        n: wires_transports.number_marks(SCENE.draw(n, 0.0, PIPER.poses["home"])["cam_high"]) for n in (3, 4)
    }
    sent = [n / 10 for n in range(6)]
    looks: Any = [
        [(drawn[4], 0.0, 0.5), (drawn[3], 0.0, 0.5)],
        [(drawn[4], 0.0, 0.5), (None, 0.0, 0.5)],
    ]
    ages = wires_transports.image_ages(looks, "strip", sent)
    assert ages[0] == pytest.approx(0.2)
    assert ages[1] is None
    assert wires_transports.image_ages([[(None, 0.4, 0.5), (None, 0.3, 0.5)]], "due", []) == [
        pytest.approx(0.2)
    ]


def test_the_slowest_stream_is_what_the_sender_kept_up_with() -> None:
    fast, slow = [n / 30 for n in range(300)], [n / 10 for n in range(100)]
    assert wires_transports.sent_hz([fast, slow], 1.0, 4.0) == pytest.approx(10.0, rel=0.05)
    assert wires_transports.sent_hz(fast, 1.0, 4.0) == pytest.approx(30.0, rel=0.05)
    assert wires_transports.sent_hz([], 1.0, 4.0) is None


def test_a_transport_that_is_not_installed_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    cases = {case.name: case for case in wires_cases.cases()}
    assert wires_cases.absent(cases["zmq"]) == ""
    assert wires_cases.absent(cases["dataset"]) == ""

    def missing(config: Any) -> Any:
        raise SetupError("install it: pip install x")

    monkeypatch.setattr(variants("runtime.transports")["ros2"], "capabilities", missing)
    assert wires_cases.absent(cases["ros2"]) == "install it: pip install x"


def test_the_recording_plays_with_the_pictures_of_every_camera(tmp_path: Path) -> None:
    videos = record(tmp_path / "dataset", PIPER, 5, 30, 120, 160)
    assert videos.keys() == {camera.key for camera in PIPER.cameras}
    clock = VirtualClock()
    transport = {"kind": "dataset", "path": str(tmp_path / "dataset")}
    played = source(Receiving("agilex_piper", transport, -1), PIPER, clock)
    played.connect()
    played.begin_run()
    seen = []
    for _ in range(5):
        observation = played.receive(0.0)
        assert observation is not None
        seen.append({frame_number(picture) for picture in observation.pictures.values()})
        clock.advance(1 / 30)
    played.close()
    assert seen == [{0}, {1}, {2}, {3}, {4}]


def test_cameras_of_the_deployment_take_the_place_of_the_transports(tmp_path: Path) -> None:
    videos = record(tmp_path / "dataset", PIPER, 5, 30, 120, 160)
    tables = {key: {"kind": "file", "path": str(path)} for key, path in videos.items()}
    transport = {"kind": "dataset", "path": str(tmp_path / "dataset")}
    played = source(Receiving("agilex_piper", transport, -1, tables), PIPER, VirtualClock())
    played.connect()
    assert played.camera_health().keys() == videos.keys()
    played.close()


ROUND = {"p50": 2.0, "p99": 5.0}
OURS = {
    "protocol": "openpi",
    "round_trip_ms": ROUND,
    "cpu_ms": 0.6,
    "request_bytes": 451924.0,
    "answer_bytes": 9.0,
}
PEER = {"round_trip_ms": {"p50": 4.0, "p99": 6.0}, "cpu_ms": 0.5}
LIVE = {"transport": "zmq", "cpu_percent": 11.0, "age_ms": {"p50": 20.0, "p99": 40.0}, "observation_hz": 30.0}


def test_figures_are_named_after_protocol_and_transport() -> None:
    rows = [{**OURS, "peer": PEER, "ratio": 0.5}, {**LIVE, "idle_minutes": 10.0, "growth_mb": 0.5}]
    figures = {figure.name: figure for figure in wires.report(rows).figures}
    assert figures["roundtrip_p50_ms.openpi"].value == 2.0
    assert figures["roundtrip_p99_ms.openpi"].value == 5.0
    assert figures["request_bytes.openpi"].value == 451924.0
    assert figures["cpu_ms_per_request.openpi_client"].value == 0.5
    assert figures["ratio_to_openpi_client"].value == 0.5
    assert figures["ratio_to_openpi_client"].holds is True
    assert figures["age_p99_ms.zmq"].value == 40.0
    assert figures["growth_mb.zmq"].holds is True
    grown = wires.report([{**LIVE, "idle_minutes": 10.0, "growth_mb": 40.0}]).figures
    assert {figure.name: figure.holds for figure in grown}["growth_mb.zmq"] is False


def test_what_is_absent_has_no_figures_and_stays_among_the_rows() -> None:
    rows = [OURS, {"protocol": "lerobot", "absent": "grpcio"}, {"transport": "ros1", "absent": "rospy"}]
    made = wires.report(rows)
    assert {figure.name.partition(".")[2] for figure in made.figures} == {"openpi"}
    assert list(made.rows) == rows
