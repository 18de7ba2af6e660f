from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosedError
from websockets.sync.client import ClientConnection, connect

import robots
from runtime.core import msgpack_arrays
from runtime.core.clock import MonotonicClock
from runtime.core.errors import ContradictionError, PolicyDisconnected, PolicyError
from runtime.core.types import Observation
from runtime.policies import openpi
from runtime.policies.pictures import resize_image, to_layout
from runtime.simulation.bench.bench import BenchLayout
from runtime.simulation.bench.layout import draw_layout
from runtime.simulation.scripts.gestures import Gesture
from tests.processes import PATIENCE_S
from tests.runtime.simulation.drawn_bench import drawn

ROBOT = robots.load_robot("agilex_piper")
HOME = ROBOT.poses["home"]


@pytest.fixture
def serve(start: Any) -> Any:
    return lambda *arguments: start(
        "runtime.standins.serve", "openpi", "--robot", "agilex_piper", "--port", "0", *arguments
    )


@contextlib.contextmanager
def conversation(url: str) -> Iterator[ClientConnection]:
    with connect(url, compression=None, max_size=None, proxy=None) as connection:
        yield connection


def receive(connection: ClientConnection) -> dict[str, Any]:
    answer = connection.recv(timeout=PATIENCE_S)
    assert isinstance(answer, bytes)
    return dict(msgpack_arrays.unpack(answer))


def request(**changes: Any) -> bytes:
    picture = np.zeros((3, 8, 8), np.uint8)
    whole = {"state": HOME.astype(np.float32), "images": {"cam_high": picture}, "prompt": "wave"}
    return msgpack_arrays.pack(whole | changes)


def test_it_speaks_as_an_openpi_server_does(serve: Any) -> None:
    url = serve("--horizon", "12", "--latency-ms", "20").ready["url"]
    with conversation(url) as connection:
        assert receive(connection)["action_horizon"] == 12
        connection.send(request())
        first = receive(connection)
        connection.send(request())
        second = receive(connection)
    assert first["actions"].dtype == np.float32
    assert first["actions"].shape == (12, 14)
    assert first["server_timing"]["infer_ms"] >= 20
    assert "prev_total_ms" not in first["server_timing"]
    assert second["server_timing"]["prev_total_ms"] >= 20
    assert second["policy_timing"]["infer_ms"] >= 20
    np.testing.assert_array_equal(first["actions"], second["actions"])
    expected = Gesture(ROBOT).chunk(HOME.astype(np.float32).astype(np.float64), 12, ROBOT.control_rate)
    np.testing.assert_array_equal(first["actions"], expected)


def test_a_wrong_request_is_answered_by_a_traceback_and_code_1011(serve: Any) -> None:
    url = serve().ready["url"]
    for changes in ({"state": np.zeros(7, np.float32)}, {"images": {"a": np.zeros((3, 8, 8), np.float32)}}):
        with conversation(url) as connection:
            receive(connection)
            connection.send(request(**changes))
            text = connection.recv(timeout=PATIENCE_S)
            assert isinstance(text, str)
            assert "Traceback" in text
            assert "expected" in text
            with pytest.raises(ConnectionClosedError) as closed:
                connection.recv(timeout=PATIENCE_S)
            assert closed.value.rcvd is not None
            assert closed.value.rcvd.code == 1011


def test_healthz_answers_beside_the_websocket(serve: Any) -> None:
    port = serve().ready["port"]
    direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    with direct.open(f"http://127.0.0.1:{port}/healthz", timeout=PATIENCE_S) as answer:
        assert (answer.status, answer.read()) == (200, b"OK\n")


def test_a_server_that_dies_during_an_inference_is_gone_for_the_client(serve: Any) -> None:
    standin = serve("--fault", "die:1")
    config = openpi.Config(url=standin.ready["url"], image_size=[24, 32])
    pictures = {camera.key: np.zeros((24, 32, 3), np.uint8) for camera in ROBOT.cameras}
    shown = Observation(1, 0.0, {}, HOME.astype(np.float32), pictures)
    with contextlib.closing(openpi.build(config, ROBOT, MonotonicClock(), 30.0)) as policy:
        policy.connect()
        assert policy.infer(shown).actions.shape == (50, 14)
        with pytest.raises(PolicyDisconnected, match="closed the connection"):
            policy.infer(shown)
        assert standin.process.wait(PATIENCE_S) == 1
        with pytest.raises(PolicyError, match="no policy server listens"):
            policy.infer(shown)


def test_it_says_how_it_continues_a_chunk_and_that_this_proves_nothing(serve: Any) -> None:
    with conversation(serve("--rtc", "async_rtc").ready["url"]) as connection:
        metadata = receive(connection)
    assert metadata["rtc"]["dialect"] == "async_rtc"
    assert "no evidence for a model" in metadata["rtc"]["stand_in"]
    assert metadata["async_rtc"]["protocol_version"] == 2


def test_it_writes_its_address_and_ends_on_sigterm(serve: Any, tmp_path: Path) -> None:
    file = tmp_path / "ready.json"
    standin = serve("--ready-file", str(file))
    assert json.loads(file.read_text()) == standin.ready
    with conversation(standin.ready["url"]) as connection:
        receive(connection)
        standin.process.terminate()
        assert standin.process.wait(PATIENCE_S) == 0


def test_it_ends_when_its_lifeline_ends(serve: Any) -> None:
    process = serve().process
    process.stdin.close()
    assert process.wait(PATIENCE_S) == 0


@pytest.mark.exhaustive
def test_a_port_that_is_taken_is_said_so(serve: Any) -> None:
    port = str(serve().ready["port"])
    arguments = ["-m", "runtime.standins.serve", "openpi", "--robot", "agilex_piper", "--port", port]
    ended = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, timeout=PATIENCE_S)
    assert ended.returncode == 2
    assert f"cannot listen at 127.0.0.1:{port}" in ended.stderr


def test_an_unknown_fault_names_the_known_ones() -> None:
    arguments = ["-m", "runtime.standins.serve", "openpi", "--robot", "agilex_piper", "--fault", "boom"]
    ended = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, timeout=PATIENCE_S)
    assert ended.returncode == 2
    assert "'boom' is no fault; allowed: mute_on_connect" in ended.stderr


@pytest.mark.exhaustive
def test_the_pick_and_place_policy_says_what_it_is_and_moves_only_for_a_block_that_it_sees(
    serve: Any,
) -> None:
    url = serve(
        "--behaviour", "pick_place", "--name", "checkpoint A", "--noise", "2", "--horizon", "40"
    ).ready["url"]
    with conversation(url) as connection:
        metadata = receive(connection)
        connection.send(request(images={"cam_high": np.zeros((3, 224, 224), np.uint8)}))
        dark = receive(connection)["actions"]
        seen = resize_image(drawn(draw_layout(0)), 224, 224, "pad")
        connection.send(request(images={"cam_high": to_layout(seen, "chw")}))
        moving = receive(connection)["actions"]
    assert metadata["name"] == "checkpoint A"
    assert "scripted pick-and-place" in metadata["description"]
    assert metadata["noise_mm"] == 2.0
    assert dark.shape == moving.shape == (40, 14)
    np.testing.assert_array_equal(dark, np.tile(HOME.astype(np.float32), (40, 1)))
    assert np.abs(moving[-1] - HOME).max() > 0.05


@pytest.mark.exhaustive
def test_the_chase_says_what_it_is_and_moves_only_for_a_block_that_it_sees(serve: Any) -> None:
    url = serve("--behaviour", "chase", "--horizon", "40").ready["url"]
    with conversation(url) as connection:
        metadata = receive(connection)
        connection.send(request(images={"cam_high": np.zeros((3, 224, 224), np.uint8)}))
        dark = receive(connection)["actions"]
        seen = resize_image(drawn(BenchLayout(((0.1, 0.34, 0.0),), ((-0.3, 0.15),))), 224, 224, "pad")
        connection.send(request(images={"cam_high": to_layout(seen, "chw")}))
        moving = receive(connection)["actions"]
    assert metadata["name"] == "chase"
    assert "not a learned policy" in metadata["description"]
    np.testing.assert_array_equal(dark, np.tile(HOME.astype(np.float32), (40, 1)))
    assert np.abs(moving[-1] - HOME).max() > 0.3


@pytest.mark.some(1)
@pytest.mark.parametrize(
    ("options", "said"),
    [
        (
            ("--behaviour", "chase", "--noise", "5"),
            "for --behaviour pick_place and sorting; no other fails on purpose",
        ),
        (("--noise", "5"), "--noise and --failure-rate are for --behaviour pick_place"),
        (("--behaviour", "pick_place", "--failure-rate", "1.5"), "1.5 was given; allowed: 0 to 1"),
        (("--behaviour", "dance"), "invalid choice: 'dance'"),
        (("--pose", "orientation=xyzw"), "--pose orientation=xyzw: allowed with --space eef"),
        (
            ("--space", "eef", "--rtc", "prev_action"),
            "--rtc prev_action with --space eef: it continues joint rows",
        ),
        (("--space", "eef", "--pose", "frame=moon"), "moon"),
        (("--groups", "left_arm,tail"), "tail"),
    ],
)
def test_options_that_make_no_sense_are_refused(options: tuple[str, ...], said: str) -> None:
    arguments = ["-m", "runtime.standins.serve", "openpi", "--robot", "agilex_piper", "--port", "0", *options]
    ended = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, timeout=PATIENCE_S)
    assert ended.returncode == 2
    assert said in ended.stderr


def test_it_answers_in_poses_of_the_format_that_is_asked_for_and_says_so(serve: Any) -> None:
    url = serve("--space", "eef", "--pose", "orientation=6d", "--pose", "gripper=false").ready["url"]
    with conversation(url) as connection:
        metadata = receive(connection)
        connection.send(request())
        answer = receive(connection)
    assert (metadata["action_space"], metadata["action_dim"]) == ("eef", 18)
    assert metadata["action_pose"]["orientation"] == "6d"
    assert answer["actions"].shape == (50, 18)
    assert "origin_actions" not in answer
    pose = ROBOT.arms[0].pose(HOME)
    np.testing.assert_allclose(answer["actions"][0, :3], pose[:3], atol=0.02)


def test_a_client_that_has_it_otherwise_is_told_so(serve: Any) -> None:
    url = serve("--space", "eef", "--pose", "orientation=xyzw").ready["url"]
    config = openpi.Config(url=url, action_space="eef")
    said = r"action_pose.orientation = 'xyzw', .* = 'wxyz'"
    policy = openpi.build(config, ROBOT, MonotonicClock(), 30.0)
    with contextlib.closing(policy), pytest.raises(ContradictionError, match=said):
        policy.connect()


def test_a_robot_may_have_its_optional_groups(start: Any) -> None:
    groups = ["left_arm", "right_arm", "torso"]
    robot = robots.load_robot("r1_lite", groups)
    arguments = ("openpi", "--robot", "r1_lite", "--groups", ",".join(groups), "--port", "0")
    with conversation(start("runtime.standins.serve", *arguments).ready["url"]) as connection:
        receive(connection)
        connection.send(request(state=robot.poses["home"].astype(np.float32)))
        actions = receive(connection)["actions"]
    torso = robot.group("torso").slice
    assert actions.shape == (50, robot.dim)
    np.testing.assert_allclose(actions[:, torso], np.tile(robot.poses["home"][torso], (50, 1)), atol=1e-6)
