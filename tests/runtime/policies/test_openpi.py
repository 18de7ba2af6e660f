from __future__ import annotations

import contextlib
import dataclasses
import socket
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from websockets.http11 import Request
from websockets.server import ServerProtocol
from websockets.sync.server import ServerConnection, serve

import robots
from runtime.core import msgpack_arrays
from runtime.core.clock import MonotonicClock
from runtime.core.errors import (
    ConfigurationError,
    ContradictionError,
    PolicyDisconnected,
    PolicyError,
    PolicyLostError,
    PolicyTimeout,
    UnreachableError,
    UnsolicitedError,
    WrongProtocolError,
)
from runtime.core.pose_format import PoseFormat
from runtime.core.types import Conditioning, Observation
from runtime.policies import openpi
from runtime.policies.openpi import Config, OpenpiPolicy
from runtime.policies.websocket_link import CLOSING, WebsocketLink, error_headline
from runtime.simulation.scripts.pose_script import PoseScript
from runtime.simulation.scripts.script import WavingScript
from runtime.standins.faults import NONE, TOO_LARGE, Fault
from runtime.standins.openpi_server import Behaviour, OpenpiServer
from tests.processes import PATIENCE_S, joined

ROBOT = robots.load_robot("agilex_piper")
CAMERAS = tuple(camera.key for camera in ROBOT.cameras)
Handler = Callable[[ServerConnection], None]
POSES = np.array([0.1, 0.2, 0.3, 0.1, 0.7, -0.5, 0.5, 0.02, 0.4, 0.5, 0.6, 0, 1, 0, 0, 0.03], np.float32)


def observation(value: float = 0.1, **changes: Any) -> Observation:
    pictures = {key: np.full((48, 64, 3), index, np.uint8) for index, key in enumerate(CAMERAS)}
    made = Observation(
        sequence=1,
        arrived=0.0,
        captured={},
        qpos=np.full(ROBOT.dim, value, np.float32),
        pictures=pictures,
        prompt="pick the block",
    )
    return dataclasses.replace(made, **changes)


@contextlib.contextmanager
def policy_at(url: str, **settings: Any) -> Iterator[OpenpiPolicy]:
    config = Config(url=url, **{"connect_deadline": 10.0, "image_size": [24, 32], **settings})
    policy = openpi.build(config, ROBOT, MonotonicClock(), ROBOT.control_rate)
    with contextlib.closing(policy):
        yield policy


@contextlib.contextmanager
def served(fault: Fault = NONE, **behaviour: Any) -> Iterator[str]:
    with contextlib.closing(OpenpiServer(ROBOT, Behaviour(fault=fault, **behaviour))) as server:
        yield str(server.start()["url"])


@contextlib.contextmanager
def stub(handler: Handler) -> Iterator[str]:
    """A websocket server that does what a test says."""
    with serve(handler, "127.0.0.1", 0, compression=None, close_timeout=0.5) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        finally:
            server.shutdown()
            thread.join()


def replying(reply: object, metadata: object = None, seen: list[Any] | None = None) -> Handler:
    def converse(connection: ServerConnection) -> None:
        connection.send(msgpack_arrays.pack(metadata or {}))
        for request in connection:
            if seen is not None:
                seen.append(request)
            connection.send(reply if isinstance(reply, bytes) else msgpack_arrays.pack(reply))

    return converse


@contextlib.contextmanager
def raw_server(answer: bytes, end: bool = True) -> Iterator[int]:
    """A TCP server that says `answer` to whoever connects, and nothing more."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        held: list[socket.socket] = []

        def accept() -> None:
            with contextlib.suppress(OSError):
                peer = listener.accept()[0]
                held.append(peer)
                if answer:
                    peer.recv(65536)
                    peer.sendall(answer)
                    if end:
                        peer.shutdown(socket.SHUT_WR)

        thread = threading.Thread(target=accept)
        thread.start()
        yield listener.getsockname()[1]
        thread.join()
        for peer in held:
            peer.close()


def test_who_hangs_up_at_once_is_lost_whether_or_not_our_first_word_was_out() -> None:
    tries = 20
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def hang_up() -> None:
            for _ in range(tries):
                listener.accept()[0].close()

        thread = threading.Thread(target=hang_up)
        thread.start()
        for _ in range(tries):
            link = WebsocketLink(f"ws://127.0.0.1:{listener.getsockname()[1]}", {}, 10.0)
            with pytest.raises(PolicyLostError, match="see that the policy server runs"):
                link.open()
        thread.join()


@contextlib.contextmanager
def not_reading_server() -> Iterator[str]:
    """A websocket server that sends its metadata and then never reads again."""
    ended = threading.Event()

    def converse() -> None:
        peer = listener.accept()[0]
        protocol = ServerProtocol()
        protocol.receive_data(peer.recv(65536))
        (request,) = protocol.events_received()
        assert isinstance(request, Request)
        protocol.send_response(protocol.accept(request))
        protocol.send_binary(msgpack_arrays.pack({}))
        for data in protocol.data_to_send():
            peer.sendall(data)
        ended.wait()
        peer.close()

    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=converse)
        thread.start()
        try:
            yield f"ws://127.0.0.1:{listener.getsockname()[1]}"
        finally:
            ended.set()
            thread.join()


def row_zero_starts_at(chunk: Any, value: float) -> bool:
    return bool(np.abs(chunk.actions[0] - np.clip(value, ROBOT.lower, ROBOT.upper)).max() < 0.05)


# A conversation that goes well


def test_it_reads_the_metadata_on_connect() -> None:
    with served(horizon=20) as url, policy_at(url) as policy:
        info = policy.connect()
    assert info.name == "stand-in"
    assert info.horizon == 20
    assert info.action_space is None
    assert not info.supports_rtc
    assert info.metadata["action_horizon"] == 20


def test_it_returns_the_rows_that_belong_to_its_observation() -> None:
    with served(horizon=20) as url, policy_at(url) as policy:
        policy.connect()
        for value in (0.05, 0.4, 0.2):
            chunk = policy.infer(observation(value))
            assert chunk.actions.shape == (20, ROBOT.dim)
            assert chunk.actions.dtype == np.float32
            assert chunk.space == "joint"
            assert row_zero_starts_at(chunk, value)


def test_it_keeps_the_servers_figures_and_the_round_trip() -> None:
    with served(latency=0.02) as url, policy_at(url) as policy:
        policy.connect()
        policy.infer(observation())
        timing = policy.infer(observation()).timing
    assert timing["server.infer_ms"] >= 20.0
    assert timing["policy.infer_ms"] >= 20.0
    assert timing["server.prev_total_ms"] >= 20.0
    assert timing["round_trip_ms"] >= timing["server.infer_ms"]


def test_it_connects_by_itself_where_nobody_did() -> None:
    with served() as url, policy_at(url) as policy:
        assert row_zero_starts_at(policy.infer(observation(0.3)), 0.3)


def test_it_sends_the_key_that_the_environment_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LAB_POLICY_KEY", "secret")
    keys = []

    def converse(connection: ServerConnection) -> None:
        assert connection.request is not None
        keys.append(connection.request.headers.get("Authorization"))
        connection.send(msgpack_arrays.pack({}))

    with stub(converse) as url, policy_at(url, api_key_env="LAB_POLICY_KEY") as policy:
        policy.connect()
    assert keys == ["Api-Key secret"]


def test_it_keeps_the_models_own_rows_for_later_conditioning() -> None:
    reply = {"actions": np.zeros((4, ROBOT.dim)), "origin_actions": np.ones((4, 32), np.float32)}
    with stub(replying(reply)) as url, policy_at(url) as policy:
        chunk = policy.infer(observation())
    assert chunk.model_actions is not None
    np.testing.assert_array_equal(chunk.model_actions, np.ones((4, 32), np.float32))
    assert chunk.model_relative is None  # nobody says


@pytest.mark.parametrize("said", ["absolute", "relative"])
def test_what_the_models_own_rows_are_is_declared(said: str) -> None:
    reply = {"actions": np.zeros((4, ROBOT.dim)), "origin_actions": np.ones((4, 32), np.float32)}
    with stub(replying(reply)) as url, policy_at(url, rtc_model_rows=said) as policy:
        assert policy.infer(observation()).model_relative is (said == "relative")


CONVERTED: dict[str, Any] = {"gripper": "droid", "action_scale": ([0.2] * 6 + [1.0]) * 2}


@pytest.mark.parametrize("mode", ["absolute", "delta", "relative"])
def test_grippers_and_scales_of_a_checkpoint_are_the_robots_in_the_chunk_and_its_own_where_it_continues(
    mode: str,
) -> None:
    rows, seen = np.tile(np.float32([0.5] * 6 + [0.25]), (4, 2)), []
    settings = CONVERTED | {"action_mode": mode, "rtc": "prev_action"}
    with stub(replying({"actions": rows}, seen=seen)) as url, policy_at(url, **settings) as policy:
        chunk = policy.infer(observation())
        assert policy.request(observation(0.0))["state"][6] == 1.0  # type: ignore[index]
        own = chunk.actions if chunk.model_actions is None else chunk.model_actions
        policy.infer(observation(), Conditioning(own, 1, 2, 4))
    np.testing.assert_allclose(chunk.actions[0], ([0.1] * 6 + [0.075]) * 2, atol=1e-6)
    np.testing.assert_allclose(msgpack_arrays.unpack(seen[1])["prev_action"], rows, atol=1e-6)
    with pytest.raises(
        ConfigurationError, match="action_scale has 1 numbers; the rows of this robot have 14"
    ):
        openpi.build(Config(action_scale=[1.0]), ROBOT, MonotonicClock(), 30.0)


def test_a_chunk_says_what_its_numbers_are_and_how_fast_they_come() -> None:
    settings: dict[str, Any] = {"action_mode": "delta", "relative_frame": "tool", "action_rate": 15.0}
    with stub(replying({"actions": np.zeros((3, 16))})) as url:
        with policy_at(url, action_space="eef", **settings) as policy:
            chunk = policy.infer(observation())
        with policy_at(url, action_space="eef") as policy:
            plain = policy.infer(observation())
    assert (chunk.mode, chunk.frame, chunk.rate) == ("delta", "tool", 15.0)
    assert (plain.mode, plain.frame, plain.rate) == ("absolute", "base", None)


# Requests


def request_of(shown: Observation | None = None, **settings: Any) -> dict[str, Any]:
    policy = openpi.build(Config(**settings), ROBOT, MonotonicClock(), 30.0)
    return dict(msgpack_arrays.unpack(msgpack_arrays.pack(policy.request(shown or observation()))))


def test_the_request_has_state_pictures_and_prompt_in_the_trained_size() -> None:
    request = request_of()
    assert list(request) == ["state", "images", "prompt"]
    assert request["state"].dtype == np.float32
    assert list(request["images"]) == list(CAMERAS)
    assert all(picture.shape == (3, 224, 224) for picture in request["images"].values())
    assert request["prompt"] == "pick the block"


def test_pictures_go_out_as_they_are_if_no_resizing_is_wanted() -> None:
    for settings in ({"image_size": None}, {"resize": "none"}):
        request = request_of(image_layout="hwc", **settings)
        np.testing.assert_array_equal(request["images"]["cam_left_wrist"], np.full((48, 64, 3), 1, np.uint8))


def test_a_flat_layout_with_a_divided_state_can_be_declared() -> None:
    request = request_of(
        images_key="",
        cameras={
            "cam_high": "observation/exterior_image_1_left",
            "cam_left_wrist": "observation/wrist_image_left",
        },
        state_key="",
        state_parts={"observation/joint_position": [0, 1, 2, 3, 4, 5], "observation/gripper_position": [6]},
        image_layout="hwc",
    )
    assert request["observation/exterior_image_1_left"].shape == (224, 224, 3)
    assert request["observation/wrist_image_left"].max() == 1
    assert request["observation/joint_position"].shape == (6,)
    assert request["observation/gripper_position"].shape == (1,)
    assert set(request) == {
        "observation/exterior_image_1_left",
        "observation/wrist_image_left",
        "observation/joint_position",
        "observation/gripper_position",
        "prompt",
    }


def test_poses_are_the_state_if_the_policy_was_trained_so() -> None:
    np.testing.assert_array_equal(request_of(observation(eef=POSES), observation_space="eef")["state"], POSES)
    with pytest.raises(PolicyError, match="no poses"):
        request_of(observation_space="eef")
    with pytest.raises(PolicyError, match="12 numbers of poses; expected 16"):
        request_of(observation(eef=POSES[:12]), observation_space="eef")


def test_poses_are_written_as_the_policy_was_trained_with_them() -> None:
    pose = PoseFormat(orientation="euler", euler_order="ZYX", degrees=True, gripper=False)
    settings = {"observation_space": "eef", "observation_pose": pose}
    state = request_of(observation(eef=POSES), **settings, state_parts={"turn": [3, 4, 5]})
    assert state["state"].shape == (12,)
    np.testing.assert_allclose(state["state"][6:12], [0.4, 0.5, 0.6, 0, 0, 180], atol=1e-4)
    expected = Rotation.from_quat(POSES[3:7], scalar_first=True).as_euler("ZYX", degrees=True)
    np.testing.assert_allclose(state["turn"], expected, atol=1e-4)
    with pytest.raises(ConfigurationError, match="allowed: 0 to 11"):
        request_of(observation(eef=POSES), **settings, state_parts={"gripper": [12]})


def test_measured_poses_without_direction_are_not_shown_to_a_policy() -> None:
    with pytest.raises(PolicyError, match="the robot measured no orientation for left_arm in row 0"):
        request_of(observation(eef=np.zeros(16, np.float32)), observation_space="eef")


@pytest.mark.parametrize("side", ["observation", "action"])
def test_a_frame_that_is_none_is_refused_before_anything_is_connected(side: str) -> None:
    settings: dict[str, Any] = {f"{side}_space": "eef", f"{side}_pose": PoseFormat(frame="moon")}
    with pytest.raises(ConfigurationError, match=rf"policy\.{side}_pose\.frame = 'moon'"):
        openpi.build(Config(**settings), ROBOT, MonotonicClock(), 30.0)


def test_a_missing_picture_is_named() -> None:
    two = observation(pictures={key: np.zeros((8, 8, 3), np.uint8) for key in CAMERAS[:2]})
    with pytest.raises(PolicyError, match="no picture 'cam_right_wrist'; it has cam_high, cam_left_wrist"):
        request_of(two, cameras={key: key for key in CAMERAS})


def test_without_named_cameras_the_policy_gets_the_pictures_that_there_are() -> None:
    two = observation(pictures={key: np.zeros((8, 8, 3), np.uint8) for key in CAMERAS[:2]})
    assert set(request_of(two)["images"]) == set(CAMERAS[:2])
    assert request_of(two, cameras={})["images"] == {}


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"cameras": {"cam_low": "cam_low"}}, "policy.cameras names cam_low"),
        ({"state_parts": {"gripper": [14]}}, "allowed: 0 to 13"),
        ({"api_key_env": "SURELY_NOT_SET"}, "SURELY_NOT_SET, which is not set"),
    ],
)
def test_a_layout_that_does_not_fit_the_robot_is_refused_at_once(settings: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigurationError, match=says):
        openpi.build(Config(**settings), ROBOT, MonotonicClock(), 30.0)


def test_conditioning_is_refused_because_the_server_would_drop_it_silently() -> None:
    conditioning = Conditioning(np.zeros((2, ROBOT.dim), np.float32), 1, 0, 2)
    with policy_at("ws://127.0.0.1:9") as policy, pytest.raises(PolicyError, match="RTC"):
        policy.infer(observation(), conditioning)


# What does not answer, or not as it should, when we connect


def test_a_port_where_nobody_listens_is_said_to_be_empty() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    with (
        policy_at(f"ws://127.0.0.1:{port}") as policy,
        pytest.raises(PolicyLostError, match="no policy server listens"),
    ):
        policy.connect()


def test_http_404_is_said_to_be_another_web_server() -> None:
    with (
        served(Fault("http_404")) as url,
        policy_at(url) as policy,
        pytest.raises(PolicyError, match="HTTP 404"),
    ):
        policy.connect()


def test_a_web_server_that_does_not_upgrade_is_named() -> None:
    answer = b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\nhi"
    with (
        raw_server(answer) as port,
        policy_at(f"ws://127.0.0.1:{port}") as policy,
        pytest.raises(PolicyError, match="HTTP 200"),
    ):
        policy.connect()


@pytest.mark.parametrize("where", [b"http://127.0.0.1:1/", b"ws://127.0.0.1:1/"])
def test_a_web_server_that_points_elsewhere_is_not_followed(where: bytes) -> None:
    answer = b"HTTP/1.1 302 Found\r\nLocation: " + where + b"\r\nContent-Length: 0\r\n\r\n"
    with (
        raw_server(answer) as port,
        policy_at(f"ws://127.0.0.1:{port}") as policy,
        pytest.raises(PolicyError, match="points elsewhere"),
    ):
        policy.connect()


@pytest.mark.parametrize(
    ("answer", "lost"),
    [
        (b"HTTP/1.1 503 Service Unavailable\r\nContent-Length: 0\r\n\r\n", True),
        (b"HTTP/1.1 50", True),  # the end comes in the middle
        (b"HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\n\r\n", False),
        (b"SSH-2.0-OpenSSH_9.6\r\n", False),
    ],
)
def test_what_may_come_back_is_told_from_what_will_never_be_a_policy_server(
    answer: bytes, lost: bool
) -> None:
    with (
        raw_server(answer) as port,
        policy_at(f"ws://127.0.0.1:{port}") as policy,
        pytest.raises(PolicyError) as raised,
    ):
        policy.connect()
    assert isinstance(raised.value, PolicyLostError) == lost


def test_a_host_that_nobody_knows_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(*given: object, **options: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    with (
        policy_at("ws://nobody.invalid:8000") as policy,
        pytest.raises(PolicyLostError, match=r"the host of ws://nobody\.invalid:8000 is not known"),
    ):
        policy.connect()


def test_a_name_that_can_be_no_host_is_said_to_be_unknown() -> None:
    with (
        policy_at("ws://two..dots:8000") as policy,
        pytest.raises(PolicyLostError, match=r"the host of ws://two\.\.dots:8000 is not known"),
    ):
        policy.connect()


def test_a_name_that_is_never_resolved_does_not_outlast_the_deadline(monkeypatch: pytest.MonkeyPatch) -> None:
    ended = threading.Event()
    monkeypatch.setattr(
        socket, "getaddrinfo", lambda *given, **options: [None] * (not ended.wait(PATIENCE_S))
    )
    with (
        policy_at("ws://slow.invalid:8000", connect_deadline=0.2) as policy,
        pytest.raises(UnreachableError, match=r"was not reached within 0\.2 s"),
    ):
        policy.connect()
    ended.set()


@pytest.mark.parametrize("end", [True, False])
def test_a_server_of_another_kind_is_said_not_to_speak_websocket(end: bool) -> None:
    """Also one that waits for the next word, as a real SSH server does."""
    with (
        raw_server(b"SSH-2.0-OpenSSH_9.6\r\n", end) as port,
        policy_at(f"ws://127.0.0.1:{port}", connect_deadline=1.0) as policy,
        pytest.raises(WrongProtocolError, match="does not speak websocket"),
    ):
        policy.connect()


def test_a_port_that_accepts_and_says_nothing_times_out() -> None:
    with (
        raw_server(b"") as port,
        policy_at(f"ws://127.0.0.1:{port}", connect_deadline=0.2) as policy,
        pytest.raises(PolicyTimeout, match=r"no websocket handshake within 0\.2 s"),
    ):
        policy.connect()


def test_a_server_that_sends_no_metadata_times_out() -> None:
    with (
        served(Fault("mute_on_connect")) as url,
        policy_at(url, connect_deadline=0.3) as policy,
        pytest.raises(PolicyTimeout, match=r"did not send its metadata within 0\.3 s"),
    ):
        policy.connect()


def test_a_text_frame_first_is_the_servers_error() -> None:
    with (
        served(Fault("text_first")) as url,
        policy_at(url) as policy,
        pytest.raises(PolicyError, match="checkpoint could not be loaded"),
    ):
        policy.connect()


@pytest.mark.parametrize(
    ("first", "says"),
    [(b"\xc1\xc1", "not the openpi protocol"), (msgpack_arrays.pack([1]), "is a list; expected a map")],
)
def test_a_first_frame_that_is_no_map_is_the_wrong_protocol(first: bytes, says: str) -> None:
    with (
        stub(lambda connection: connection.send(first)) as url,
        policy_at(url) as policy,
        pytest.raises(PolicyError, match=says),
    ):
        policy.connect()


@pytest.mark.parametrize(
    ("mode", "says"),
    [
        ("eef", "actions are 'eef', policy.action_space is 'joint'"),
        ("torque", "'torque'; allowed: joint, qpos, eef"),
        ("delta", "has action_mode = 'delta', policy.action_mode = 'absolute'"),
    ],
)
def test_metadata_may_not_contradict_the_configured_space(mode: str, says: str) -> None:
    with (
        served(Fault("action_mode", mode)) as url,
        policy_at(url) as policy,
        pytest.raises(PolicyError, match=says),
    ):
        policy.connect()


def test_metadata_that_agree_are_reported() -> None:
    with served(Fault("action_mode", "qpos")) as url, policy_at(url) as policy:
        assert policy.connect().action_space == "joint"


SIX = {"action_space": "eef", "action_pose": PoseFormat(orientation="6d", gripper=False)}
XYZW = {"action_space": "eef", "action_pose": PoseFormat(orientation="xyzw")}


@pytest.mark.parametrize(
    ("settings", "metadata", "says"),
    [
        ({}, {"action_space": "eef"}, "actions are 'eef', policy.action_space is 'joint'"),
        ({}, {"action_space": "wheels"}, "action_space 'wheels'; allowed: joint, qpos, eef"),
        ({}, {"action_dim": 16}, "action_dim = 16, policy.action_space: joints of this robot, numbers = 14"),
        (SIX, {"action_dim": 16}, r"poses \(6d of columns without gripper\) of this robot, numbers = 18"),
        ({}, {"action_rate": 15}, "action_rate = 15, policy.action_rate = 30.0"),
        ({"action_rate": 15.0}, {"action_rate": 30}, "action_rate = 30, policy.action_rate = 15.0"),
        (SIX, {"orientation": "xyzw"}, "orientation = 'xyzw', policy.action_pose.orientation = '6d'"),
        (SIX, {"action_orientation": "rpy"}, "= 'euler', policy.action_pose.orientation = '6d'"),
        (
            XYZW,
            {"action_pose": {"orientation": "quat_wxyz"}},
            "= 'wxyz', policy.action_pose.orientation = 'xyzw'",
        ),
        (SIX, {"action_pose": {"sixd": "rows"}}, "sixd = 'rows', policy.action_pose.sixd = 'columns'"),
        (
            {"observation_space": "eef"},
            {"observation_orientation": "rot6d"},
            "= '6d', policy.observation_pose.orientation = 'wxyz'",
        ),
        ({}, {"image_size": [480, 640]}, r"image_size = \[480, 640\], policy.image_size = \[24, 32\]"),
        ({}, {"image_resolution": 224}, r"image_resolution = \[224, 224\], policy.image_size = \[24, 32\]"),
        (
            SIX | {"action_mode": "delta"},
            {"relative_frame": "tool"},
            "'tool', policy.relative_frame = 'base'",
        ),
    ],
)
def test_metadata_that_contradict_the_configuration_are_an_error_with_both_sides(
    settings: dict[str, Any], metadata: dict[str, Any], says: str
) -> None:
    with (
        stub(replying({}, metadata)) as url,
        policy_at(url, **settings) as policy,
        pytest.raises(ContradictionError, match=says),
    ):
        policy.connect()


@pytest.mark.parametrize(
    ("settings", "metadata"),
    [
        ({}, {"action_dim": 14, "action_rate": 30, "image_size": [24, 32, 3], "orientation": "rpy"}),
        ({}, {"training_obs_image_size": np.array([3, 24, 32]), "action_mode": "absolute"}),
        (SIX, {"action_dim": 18, "orientation": "ROT6D", "action_pose": {"frame": "", "gripper": False}}),
        (XYZW, {"orientation": "quat", "action_pose": {"orientation": "quaternion"}}),
        ({"resize": "none"}, {"image_size": [480, 640]}),
    ],
)
def test_metadata_that_say_the_same_are_no_contradiction(
    settings: dict[str, Any], metadata: dict[str, Any]
) -> None:
    with stub(replying({}, metadata)) as url, policy_at(url, **settings) as policy:
        assert policy.connect().action_space is None


@contextlib.contextmanager
def posing(pose: PoseFormat) -> Iterator[str]:
    """The stand-in server, answering in poses of that format and saying so."""
    script = PoseScript(WavingScript(ROBOT, 12, 30.0), ROBOT, 30.0, pose)
    with contextlib.closing(OpenpiServer(ROBOT, Behaviour(horizon=12, rtc="none"), script=script)) as server:
        yield str(server.start()["url"])


def test_a_server_that_answers_in_the_declared_format_is_understood() -> None:
    pose = PoseFormat(orientation="euler", euler_order="YXZ", frame="world", gripper=False)
    with posing(pose) as url, policy_at(url, action_space="eef", action_pose=pose) as policy:
        assert policy.connect().action_space == "eef"
        chunk = policy.infer(observation())
    assert chunk.actions.shape == (12, 12)
    assert chunk.pose == pose


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"frame": ""}, "action_pose.frame = 'world', policy.action_pose.frame = ''"),
        ({"euler_order": "yxz"}, "euler_order = 'YXZ', policy.action_pose.euler_order = 'yxz'"),
        ({"gripper": True}, "action_dim = 12"),
    ],
)
def test_a_server_that_answers_in_another_format_is_refused_at_set_up(
    changes: dict[str, Any], says: str
) -> None:
    pose = PoseFormat(orientation="euler", euler_order="YXZ", frame="world", gripper=False)
    other = pose.model_copy(update=changes)
    with (
        posing(pose) as url,
        policy_at(url, action_space="eef", action_pose=other) as policy,
        pytest.raises(ContradictionError, match=says),
    ):
        policy.connect()


# What goes wrong with an answer


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        ("wrong_dim", "rows of 13 numbers; this robot needs 14"),
        ("nan", "nan at row 3, column 2"),
        ("empty", "actions is empty"),
        ("two_batches", r"shape \[2, 50, 14\]"),
        ("bad_array_dialect", "MNP"),
        ("object_array", "refused"),
        ("exception", r"RuntimeError: CUDA out of memory"),
    ],
)
def test_an_unusable_answer_is_named(fault: str, says: str) -> None:
    with served(Fault(fault)) as url, policy_at(url) as policy:
        policy.connect()
        with pytest.raises(PolicyError, match=says):
            policy.infer(observation())


@pytest.mark.parametrize(("fault", "rows"), [("batched", 50), ("single_row", 1)])
def test_one_batch_and_one_row_are_understood(fault: str, rows: int) -> None:
    with served(Fault(fault)) as url, policy_at(url) as policy:
        assert policy.infer(observation()).actions.shape == (rows, ROBOT.dim)


@pytest.mark.parametrize(
    ("reply", "says"),
    [
        ({"result": 1}, "no 'actions'; it has result"),
        ({"actions": [[0.0] * 14]}, "actions is a list"),
        ({"actions": np.zeros((2, 14), bool)}, "dtype"),
        ({"actions": np.full((1, 14), 1e300)}, "row 0, column 0"),
        ({"actions": np.zeros((1, 14)), "action_mode": "eef"}, "answer says that actions are 'eef'"),
        ({"actions": np.zeros((1, 14)), "action_mode": ["eef"]}, "allowed: joint, qpos, eef"),
        (
            {"actions": np.zeros((1, 14)), "origin_actions": np.full((1, 32), np.inf)},
            "origin_actions has inf",
        ),
        ([1, 2], "an answer that is a list"),
        (b"\xc1", "not the openpi protocol"),
    ],
)
def test_a_strange_answer_is_named(reply: object, says: str) -> None:
    with stub(replying(reply)) as url, policy_at(url) as policy:
        policy.connect()
        with pytest.raises(PolicyError, match=says):
            policy.infer(observation())


def test_whole_numbers_become_float32() -> None:
    with stub(replying({"actions": np.ones((2, 14), np.int64)})) as url, policy_at(url) as policy:
        actions = policy.infer(observation()).actions
    assert actions.dtype == np.float32
    assert actions.tolist() == [[1.0] * 14] * 2


def test_poses_have_eight_numbers_per_arm() -> None:
    reply = {"actions": np.zeros((3, 16)), "action_mode": "eef"}
    with stub(replying(reply)) as url, policy_at(url, action_space="eef") as policy:
        chunk = policy.infer(observation())
    assert chunk.space == "eef"
    assert chunk.actions.shape == (3, 16)
    assert chunk.pose == PoseFormat()


def test_the_width_of_an_answer_is_that_of_the_declared_format() -> None:
    pose = PoseFormat(orientation="6d")
    with stub(replying({"actions": np.ones((3, 20))})) as url:
        with policy_at(url, action_space="eef", action_pose=pose) as policy:
            chunk = policy.infer(observation())
        with (
            policy_at(url, action_space="eef") as policy,
            pytest.raises(PolicyError, match="rows of 20 numbers; this robot needs 16"),
        ):
            policy.infer(observation())
    assert chunk.pose == pose
    assert chunk.actions.shape == (3, 20)


def test_a_text_frame_at_any_time_is_the_servers_error() -> None:
    def converse(connection: ServerConnection) -> None:
        connection.send(msgpack_arrays.pack({}))
        connection.recv()
        connection.send("Traceback (most recent call last):\n  somewhere\nKeyError: 'state'\n")

    with stub(converse) as url, policy_at(url) as policy:
        policy.connect()
        with pytest.raises(PolicyError, match="reports an error: KeyError: 'state'\nTraceback"):
            policy.infer(observation())


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ('{"error": "no model", "code": "unsupported"}', "no model, unsupported"),
        ('{"message": "busy"}', "busy"),
        ('{"status": 1}', '{"status": 1}'),
        ("[" * 100_000, "[" * 100_000),
        ("Traceback\n  x\nKeyError: 1", "KeyError: 1\nTraceback\n  x\nKeyError: 1"),
        ("", "(an empty text)"),
    ],
)
def test_of_what_a_server_says_the_sentence_comes_first(text: str, line: str) -> None:
    assert error_headline(text) == line


# What happens to the connection


def test_a_mute_server_times_out_by_the_first_and_then_by_the_later_deadline() -> None:
    settings = {"first_inference_deadline": 0.3, "inference_deadline": 0.1}
    with served(Fault("mute_on_infer")) as url, policy_at(url, **settings) as policy:
        policy.connect()
        with pytest.raises(PolicyTimeout, match=r"did not send an answer within 0\.3 s"):
            policy.infer(observation())
        with pytest.raises(PolicyTimeout, match=r"within 0\.1 s"):
            policy.infer(observation())


def test_the_later_deadline_holds_after_the_first_answer() -> None:
    settings = {"first_inference_deadline": 30.0, "inference_deadline": 0.1}
    with served(Fault("mute_on_infer", "1")) as url, policy_at(url, **settings) as policy:
        policy.connect()
        policy.infer(observation())
        with pytest.raises(PolicyTimeout, match=r"within 0\.1 s"):
            policy.infer(observation())


def test_a_late_answer_is_never_paired_with_the_next_request() -> None:
    settings = {"first_inference_deadline": 10.0, "inference_deadline": 1.0}
    with served(Fault("late_reply", "4")) as url, policy_at(url, **settings) as policy:
        policy.connect()
        assert row_zero_starts_at(policy.infer(observation(0.05)), 0.05)
        with pytest.raises(PolicyTimeout):
            policy.infer(observation(0.5))
        policy._server = policy._server.model_copy(
            update={"inference_deadline": PATIENCE_S}
        )  # all others are in time
        for value in (0.1, 0.2, 0.3, 0.4, 0.5):
            assert row_zero_starts_at(policy.infer(observation(value)), value)


def test_a_connection_that_ends_within_an_answer_is_opened_anew() -> None:
    with served(Fault("close_mid_reply", "1")) as url, policy_at(url) as policy:
        policy.connect()
        policy.infer(observation())
        with pytest.raises(PolicyDisconnected, match="closed the connection"):
            policy.infer(observation())
    with served() as url, policy_at(url) as policy:
        policy.connect()
        assert row_zero_starts_at(policy.infer(observation(0.2)), 0.2)


@contextlib.contextmanager
def left_by_its_server(**config: Any) -> Iterator[tuple[OpenpiPolicy, int]]:
    """A policy whose server was there for one answer, and the port that it listened at."""
    server = OpenpiServer(ROBOT, Behaviour())
    address = server.start()
    with policy_at(str(address["url"]), **config) as policy:
        policy.connect()
        policy.infer(observation())
        server.close()
        with pytest.raises(PolicyDisconnected):
            policy.infer(observation())
        yield policy, int(str(address["port"]))


def test_a_server_that_came_back_is_found_again() -> None:
    with left_by_its_server(first_inference_deadline=10.0, inference_deadline=5.0) as (policy, port):
        for _ in range(2):
            with pytest.raises(PolicyLostError, match="no policy server listens"):
                policy.infer(observation())
        with contextlib.closing(OpenpiServer(ROBOT, Behaviour(), port)) as again:
            again.start()
            assert row_zero_starts_at(policy.infer(observation(0.3)), 0.3)


def test_during_a_run_a_server_that_came_back_mute_is_found_out_by_the_short_deadline() -> None:
    with left_by_its_server(first_inference_deadline=60.0, inference_deadline=0.2) as (policy, port):
        mute = Behaviour(fault=Fault("mute_on_infer"))
        with contextlib.closing(OpenpiServer(ROBOT, mute, port)) as again:
            again.start()
            with pytest.raises(PolicyTimeout, match=r"within 0\.2 s"):
                policy.infer(observation())


def test_a_server_that_stops_reading_does_not_block_the_request() -> None:
    shown = observation(pictures={key: np.zeros((3000, 2000, 3), np.uint8) for key in CAMERAS})
    settings = {"image_size": None, "first_inference_deadline": 0.5}
    with not_reading_server() as url, policy_at(url, **settings) as policy:
        policy.connect()
        with pytest.raises(PolicyTimeout, match=r"did not take the request within 0\.5 s"):
            policy.infer(shown)


def test_close_unblocks_an_inference_that_waits_in_another_thread() -> None:
    asked = threading.Event()

    def converse(connection: ServerConnection) -> None:
        connection.send(msgpack_arrays.pack({}))
        connection.recv()
        asked.set()
        connection.recv()

    errors: list[BaseException] = []
    with stub(converse) as url, policy_at(url, first_inference_deadline=60.0) as policy:
        policy.connect()

        def ask() -> None:
            try:
                policy.infer(observation())
            except PolicyError as error:
                errors.append(error)

        thread = threading.Thread(target=ask)
        thread.start()
        assert asked.wait(PATIENCE_S)
        policy.close()
        joined(thread)
        policy.close()
    assert "closed from our side" in str(errors[0])


def test_close_does_not_wait_for_a_handshake_and_ends_it() -> None:
    """A server that accepts and says nothing: the deadline is a minute, the test's own far below it."""
    errors: list[PolicyError] = []

    def connect(policy: OpenpiPolicy) -> None:
        try:
            policy.connect()
        except PolicyError as error:
            errors.append(error)

    with raw_server(b"") as port, policy_at(f"ws://127.0.0.1:{port}", connect_deadline=60.0) as policy:
        thread = threading.Thread(target=connect, args=(policy,))
        thread.start()
        while policy._link._shaking is None:
            assert thread.is_alive()
        closing = threading.Thread(target=policy.close)
        closing.start()
        joined(closing, thread)
    assert "closed from our side" in str(errors[0])


@contextlib.contextmanager
def unreachable_port() -> Iterator[int]:
    """A port whose queue is full: whoever connects gets no answer at all."""
    with contextlib.ExitStack() as stack:
        listener = stack.enter_context(socket.create_server(("127.0.0.1", 0), backlog=0))
        for _ in range(8):
            waiting = stack.enter_context(socket.socket())
            waiting.setblocking(False)
            waiting.connect_ex(listener.getsockname())
        yield listener.getsockname()[1]


def test_a_host_that_does_not_answer_is_not_reached_in_time() -> None:
    with (
        unreachable_port() as port,
        policy_at(f"ws://127.0.0.1:{port}", connect_deadline=0.2) as policy,
        pytest.raises(UnreachableError, match=r"within 0\.2 s"),
    ):
        policy.connect()


def test_close_ends_the_search_for_a_host_that_does_not_answer() -> None:
    errors: list[PolicyError] = []

    def connect(policy: OpenpiPolicy) -> None:
        try:
            policy.connect()
        except PolicyError as error:
            errors.append(error)

    with unreachable_port() as port, policy_at(f"ws://127.0.0.1:{port}", connect_deadline=60.0) as policy:
        thread = threading.Thread(target=connect, args=(policy,))
        thread.start()
        thread.join(0.2)
        assert thread.is_alive()
        policy.close()
        joined(thread)
    assert "closed from our side" in str(errors[0])


def test_close_returns_while_the_wire_is_in_use() -> None:
    with served() as url, policy_at(url) as policy:
        policy.connect()
        with policy._lock:  # held by a call that cannot be woken, as by a host that does not answer
            closing = threading.Thread(target=policy.close)
            closing.start()
            joined(closing)
        policy.connect()
        assert row_zero_starts_at(policy.infer(observation(0.3)), 0.3)


def test_a_link_that_was_aborted_before_it_opened_says_so() -> None:
    with served() as url:
        link = WebsocketLink(url, {}, 10.0)
        link.abort()
        with pytest.raises(PolicyError, match="closed from our side"):
            link.open()


@pytest.mark.parametrize("farewell", [None, b"farewell"])
def test_leaving_a_server_that_does_not_read_ends_and_holds_up_no_process(farewell: bytes | None) -> None:
    with not_reading_server() as url:
        link = WebsocketLink(url, {}, 10.0)
        link.open()
        assert link._connection is not None
        with contextlib.suppress(BlockingIOError):
            while True:  # until the wire takes nothing more
                link._connection.socket.send(bytes(65536), socket.MSG_DONTWAIT)
        link.close_gracefully(farewell)
        joined(*(thread for thread in threading.enumerate() if thread.name == CLOSING))


def test_a_closed_policy_does_not_connect_by_itself_but_when_asked() -> None:
    with served() as url, policy_at(url) as policy:
        policy.connect()
        policy.close()
        with pytest.raises(PolicyError, match="is closed; connect first"):
            policy.infer(observation())
        policy.connect()
        assert row_zero_starts_at(policy.infer(observation(0.3)), 0.3)


def test_two_threads_never_share_the_wire() -> None:
    """Each gets the answer to its own request; a mix-up would show in the first row."""

    def ask(value: float) -> None:
        for _ in range(10):
            assert row_zero_starts_at(policy.infer(observation(value)), value)

    with served(horizon=5) as url, policy_at(url) as policy:
        policy.connect()
        with ThreadPoolExecutor(3) as pool:
            assert list(pool.map(ask, (0.1, 0.3, 0.5))) == [None, None, None]


def test_reset_leaves_the_conversation_as_it_is() -> None:
    with served() as url, policy_at(url) as policy:
        policy.connect()
        first = policy.infer(observation(0.2))
        policy.reset()
        np.testing.assert_array_equal(policy.infer(observation(0.2)).actions, first.actions)


def test_an_inference_while_reset_is_called_comes_back_with_its_own_answer() -> None:
    with served(latency=0.1) as url, policy_at(url) as policy:
        policy.connect()
        timer = threading.Timer(0.03, policy.reset)
        timer.start()
        assert row_zero_starts_at(policy.infer(observation(0.4)), 0.4)
        timer.join()
        assert row_zero_starts_at(policy.infer(observation(0.1)), 0.1)


# Answers and questions


def rows_of(value: float, **figures: Any) -> dict[str, Any]:
    return {"actions": np.full((5, ROBOT.dim), value, np.float32), **figures}


def test_a_policy_that_always_answers_the_same_is_asked_twice_once_and_then_believed() -> None:
    asked: list[Any] = []
    with stub(replying(rows_of(0.5), seen=asked)) as url, policy_at(url) as policy:
        for number in range(4):
            assert policy.infer(observation(0.1 * number)).actions[0, 0] == 0.5
    assert len(asked) == 5


def test_the_same_question_may_have_the_same_answer() -> None:
    asked: list[Any] = []
    with stub(replying(rows_of(0.5), seen=asked)) as url, policy_at(url) as policy:
        for _ in range(3):
            policy.infer(observation())
    assert len(asked) == 3


def test_an_answer_that_came_sooner_than_it_took_is_another_questions() -> None:
    """A server, or a proxy, that computes an answer twice: the second differs from the first in its figures."""
    conversations: list[int] = []

    def converse(connection: ServerConnection) -> None:
        conversations.append(0)
        connection.send(msgpack_arrays.pack({}))
        for request in connection:
            conversations[-1] += 1
            value = msgpack_arrays.unpack(request)["state"][0]
            late = len(conversations) == 1 and conversations[-1] == 2
            took = {"server_timing": {"infer_ms": 1e6 if late else 0.0}}
            connection.send(msgpack_arrays.pack(rows_of(0.0 if late else value, **took)))

    with stub(converse) as url, policy_at(url) as policy:
        found = [policy.infer(observation(value)).actions[0, 0] for value in (0.1, 0.2, 0.3)]
    np.testing.assert_allclose(found, [0.1, 0.2, 0.3])
    assert conversations == [2, 2]


def test_figures_that_are_no_durations_are_believed_no_more() -> None:
    asked: list[Any] = []
    with (
        stub(replying(rows_of(0.5, server_timing={"infer_ms": 1e6}), seen=asked)) as url,
        policy_at(url) as policy,
    ):
        for _ in range(3):
            policy.infer(observation())
    assert len(asked) == 4


@pytest.mark.parametrize("after", ["metadata", "answer"])
def test_what_waits_before_a_question_answers_none(after: str) -> None:
    """The copy has reached the client when that answers a ping."""
    there = threading.Event()

    def repeat(connection: ServerConnection, message: bytes, what: str) -> None:
        connection.send(message)
        if what == after and not there.is_set():
            connection.send(message)
            connection.ping().wait()
            there.set()

    def converse(connection: ServerConnection) -> None:
        repeat(connection, msgpack_arrays.pack({}), "metadata")
        for request in connection:
            value = msgpack_arrays.unpack(request)["state"][0]
            repeat(connection, msgpack_arrays.pack(rows_of(value)), "answer")

    with stub(converse) as url, policy_at(url) as policy:
        policy.connect()
        if after == "answer":
            policy.infer(observation(0.1))
        assert there.wait(PATIENCE_S)
        with pytest.raises(UnsolicitedError, match="sent an unrequested message"):
            policy.infer(observation(0.2))
        assert policy.infer(observation(0.3)).actions[0, 0] == np.float32(0.3)


def test_metadata_have_a_bound_too() -> None:
    with (
        stub(lambda connection: connection.send(bytes(TOO_LARGE))) as url,
        policy_at(url) as policy,
        pytest.raises(WrongProtocolError, match="67108865 bytes exceeds limit of 67108864 bytes"),
    ):
        policy.connect()
