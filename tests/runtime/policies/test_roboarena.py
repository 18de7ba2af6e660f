from __future__ import annotations

import contextlib
import dataclasses
import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from websockets.sync.server import ServerConnection

from runtime.core import msgpack_arrays
from runtime.core.clock import MonotonicClock
from runtime.core.errors import (
    ConfigurationError,
    ContradictionError,
    PolicyDisconnected,
    PolicyError,
    PolicyLostError,
    PolicyTimeout,
)
from runtime.core.pose_format import PoseFormat
from runtime.core.types import Conditioning, Observation
from runtime.policies import roboarena
from runtime.policies.roboarena import Config, RoboarenaPolicy
from runtime.standins.faults import Fault
from runtime.standins.roboarena_server import RoboarenaBehaviour, RoboarenaServer
from tests.runtime.policies.peers import FRANKA, PIPER, answering, seen, serving

VECTORS = Path(__file__).parents[1] / "vectors"
CAMERAS = {"cam_high": "first", "cam_left_wrist": "wrist"}
SIX = {
    "image_resolution": [24, 32],
    "needs_wrist_camera": True,
    "n_external_cameras": 1,
    "needs_stereo_camera": False,
    "needs_session_id": True,
    "action_space": "joint_position",
}
ROWS = np.arange(16, dtype=np.float32).reshape(2, 8) / 8


def built(**settings: Any) -> RoboarenaPolicy:
    robot = settings.pop("robot", FRANKA)
    config = Config(**{"connect_deadline": 10.0, "cameras": CAMERAS, **settings})
    return roboarena.build(config, robot, MonotonicClock(), 30.0)


@contextlib.contextmanager
def policy_at(url: str, **settings: Any) -> Iterator[RoboarenaPolicy]:
    with contextlib.closing(built(url=url, **settings)) as policy:
        yield policy


@contextlib.contextmanager
def served(**arena: Any) -> Iterator[tuple[RoboarenaServer, str]]:
    robot = arena.pop("robot", FRANKA)
    server = RoboarenaServer(robot, RoboarenaBehaviour(**{"resolution": (24, 32), **arena}))
    with contextlib.closing(server):
        yield server, str(server.start()["url"])


def reply_to(message: Any) -> object:
    return "reset successful" if message["endpoint"] == "reset" else {"actions": ROWS}


def changing() -> Callable[[Any], object]:
    """As `reply_to`, with other rows each time: the same bytes to another question would be doubted."""
    count = itertools.count()

    def reply(message: Any) -> object:
        found = reply_to(message)
        return found if isinstance(found, str) else {"actions": ROWS + np.float32(next(count))}

    return reply


def request_of(
    shown: Observation | None = None, metadata: dict[str, Any] | None = None, **settings: Any
) -> Any:
    asked: list[bytes] = []
    robot = settings.get("robot", FRANKA)
    rows = np.zeros((2, robot.dim), np.float32)
    with (
        serving(answering(SIX | (metadata or {}), lambda m: rows, asked)) as url,
        policy_at(url, **settings) as policy,
    ):
        policy.infer(shown or seen(robot))
    return msgpack_arrays.unpack(asked[0])


# The bytes that the field's own programs have written


def vector(name: str) -> bytes:
    return (VECTORS / f"{name}.bin").read_bytes()


def recorded_observation(size: tuple[int, ...] = (2, 3)) -> Observation:
    pixels = np.arange(np.prod(size) * 3, dtype=np.uint8).reshape(*size, 3)
    pictures = {key: pixels + np.uint8(20 * n) for n, key in enumerate(("cam_high", "cam_right_wrist"))}
    pictures["cam_left_wrist"] = pixels + np.uint8(40)
    qpos = np.array([0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0], np.float32)  # the gripper shut, which is 1 to DROID
    return seen(FRANKA, qpos=qpos, pictures=pictures, prompt="pick")


def test_a_request_is_the_recorded_one_byte_for_byte() -> None:
    asked: list[bytes] = []
    three = {"cam_high": "first", "cam_right_wrist": "second", "cam_left_wrist": "wrist"}
    with (
        serving(answering(vector("roboarena_metadata"), reply_to, asked)) as url,
        policy_at(url, cameras=three, cartesian_position="zeros") as policy,
    ):
        info = policy.connect()
        policy._session = "38DSA3hd3"
        chunk = policy.infer(recorded_observation())
        policy.reset()
    assert info.metadata["n_external_cameras"] == 2
    assert asked[0] == vector("roboarena_infer_request")
    assert asked[1].hex() == "82aa73657373696f6e5f6964a9333844534133686433a8656e64706f696e74a57265736574"
    assert chunk.actions.shape == (2, 8)


@pytest.mark.parametrize("form", ["roboarena_infer_reply_dict", "roboarena_infer_reply_bare"])
def test_both_recorded_forms_of_an_answer_are_the_same_rows(form: str) -> None:
    with (
        serving(answering(SIX, lambda m: vector(form))) as url,
        policy_at(url, gripper="robot") as policy,
    ):
        np.testing.assert_array_equal(policy.infer(seen(FRANKA)).actions, ROWS)


def test_four_frames_per_view_are_the_recorded_request() -> None:
    """The pictures of the recorded request one by one; the last request carries them all."""
    recorded = msgpack_arrays.unpack(vector("dreamzero_infer_request_4frames"))
    three = {"cam_high": "first", "cam_right_wrist": "second", "cam_left_wrist": "wrist"}
    keys = {
        "cam_high": "observation/exterior_image_0_left",
        "cam_right_wrist": "observation/exterior_image_1_left",
        "cam_left_wrist": "observation/wrist_image_left",
    }
    asked: list[bytes] = []
    metadata = SIX | {"n_external_cameras": 2, "image_resolution": None}
    with (
        serving(answering(metadata, changing(), asked)) as url,
        policy_at(url, cameras=three, cartesian_position="zeros", frames=4) as policy,
    ):
        for frame in range(4):
            pictures = {camera: recorded[key][frame] for camera, key in keys.items()}
            policy.infer(seen(FRANKA, pictures=pictures))
    first, second, *_, last = (msgpack_arrays.unpack(request) for request in asked)
    for key in keys.values():
        np.testing.assert_array_equal(last[key], recorded[key])
        np.testing.assert_array_equal(first[key], recorded[key][0])
        np.testing.assert_array_equal(second[key], recorded[key][[0, 0, 0, 1]])


def test_moments_before_a_request_are_shown_from_the_second_on_although_nobody_asked_then() -> None:
    asked: list[bytes] = []
    with (
        serving(answering(SIX | {"image_resolution": None}, changing(), asked)) as url,
        policy_at(url, frame_steps=[23, 16, 8, 0]) as policy,
    ):
        assert policy.observe_period_s == pytest.approx(1 / 15)
        for run in range(2):
            for frame in range(48):
                number = np.uint8(100 * run + frame)
                pictures = dict.fromkeys(CAMERAS, np.full((24, 32, 3), number, np.uint8))
                shown = dataclasses.replace(
                    seen(FRANKA, pictures=pictures), arrived=1000.0 * run + frame / 15
                )
                policy.observe(shown)
                if frame in (0, 23, 47):
                    policy.infer(shown)
            policy.reset()
    messages = [msgpack_arrays.unpack(request) for request in asked]
    sent = [message["observation/wrist_image_left"] for message in messages if message["endpoint"] == "infer"]
    assert [picture.shape for picture in sent[:3]] == [(24, 32, 3), (4, 24, 32, 3), (4, 24, 32, 3)]
    kept = [picture[..., 0, 0, 0].tolist() for picture in sent]
    assert kept[:3] == [0, [0, 7, 15, 23], [24, 31, 39, 47]]
    assert kept[3:] == [100, [100, 107, 115, 123], [124, 131, 139, 147]]


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        (
            {"frame_steps": [0, 8]},
            r"frame_steps = \[0, 8\]: allowed are steps before the request, oldest first",
        ),
        ({"frame_steps": [8, 8, 0]}, "oldest first, the last 0"),
        ({"frame_steps": [16, 8]}, "the last 0"),
        ({"frame_steps": [8, 0], "frames": 4}, "policy.frames = 4 and policy.frame_steps"),
    ],
)
def test_a_history_that_is_none_is_refused(settings: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigurationError, match=says):
        Config(url="ws://127.0.0.1:9", **settings)


def test_the_metadata_of_dreamzero_are_understood() -> None:
    said = bytes.fromhex(
        "86b0696d6167655f7265736f6c7574696f6e92ccb4cd0140b26e656564735f77726973745f63616d657261c3b26e5f65787465726e"
        "616c5f63616d6572617302b36e656564735f73746572656f5f63616d657261c2b06e656564735f73657373696f6e5f6964c3ac6163"
        "74696f6e5f7370616365ae6a6f696e745f706f736974696f6e"
    )
    three = CAMERAS | {"cam_right_wrist": "second"}
    asked: list[bytes] = []
    with serving(answering(said, reply_to, asked)) as url, policy_at(url, cameras=three) as policy:
        policy.infer(seen(FRANKA))
    assert msgpack_arrays.unpack(asked[0])["observation/exterior_image_1_left"].shape == (180, 320, 3)


@pytest.mark.parametrize(
    ("frame", "says"),
    [
        (
            "82a474797065a56572726f72a76d657373616765b7496e76616c69642072657175657374207061796c6f6164",
            "reports an error: Invalid request payload",
        ),
        (
            "82a474797065a56572726f72a76d657373616765b8496e7465726e616c20696e666572656e6365206572726f72",
            "reports an error: Internal inference error",
        ),
    ],
)
def test_an_error_of_vllm_omni_is_told_and_the_connection_kept(frame: str, says: str) -> None:
    with serving(answering(SIX, lambda m: bytes.fromhex(frame))) as url, policy_at(url) as policy:
        with pytest.raises(PolicyError, match=says) as raised:
            policy.infer(seen(FRANKA))
        assert not isinstance(raised.value, PolicyLostError)
        assert policy._link.is_open


# What is sent


@pytest.mark.parametrize(("numbering", "key"), [("0-based", "image_0"), ("1-based", "image_1")])
def test_the_numbering_of_the_exterior_views_is_declared(numbering: str, key: str) -> None:
    request = request_of(numbering=numbering)
    assert [name for name in request if "exterior" in name] == [f"observation/exterior_{key}_left"]
    assert request[f"observation/exterior_{key}_left"].max() == 0  # of cam_high, the first of the robot
    assert request["observation/wrist_image_left"].max() == 1


@pytest.mark.parametrize(
    ("wants", "keys"),
    [
        ({"n_external_cameras": 0}, ["wrist_image_left"]),
        ({"needs_wrist_camera": False}, ["exterior_image_0_left"]),
        ({"n_external_cameras": 0, "needs_wrist_camera": False}, []),
    ],
)
def test_only_the_views_that_the_server_wants_are_sent(wants: dict[str, Any], keys: list[str]) -> None:
    request = request_of(metadata=wants)
    assert [name for name in request if "image" in name] == [f"observation/{key}" for key in keys]


def test_stereo_views_come_from_the_cameras_that_are_declared_for_them() -> None:
    stereo = {"cam_high": "wrist", "cam_left_wrist": "wrist_stereo"}
    wants = {"n_external_cameras": 0, "needs_stereo_camera": True}
    request = request_of(metadata=wants, cameras=stereo)
    assert request["observation/wrist_image_left"].max() == 0
    assert request["observation/wrist_image_right"].max() == 1


@pytest.mark.parametrize(
    ("wants", "says"),
    [
        (
            {"n_external_cameras": 2},
            "wants observation/exterior_image_1_left .* has no 'second', only cam_high",
        ),
        ({"needs_stereo_camera": True}, "has no 'first_stereo'"),
        ({"action_space": "cartesian_position"}, "policy.action_space = 'joint_position'"),
        ({"action_dim": 7}, "action_dim = 7, this robot has 8 numbers"),
        (
            {"image_resolution": [180, 320]},
            r"image_resolution = \[180, 320\], policy.image_size = \[24, 32\]",
        ),
    ],
)
def test_a_server_that_wants_something_else_is_refused_with_both_sides(
    wants: dict[str, Any], says: str
) -> None:
    with (
        serving(answering(SIX | wants, reply_to)) as url,
        policy_at(url, image_size=[24, 32]) as policy,
        pytest.raises(ContradictionError, match=says),
    ):
        policy.connect()


@pytest.mark.parametrize(
    ("metadata", "says"),
    [
        ({"action_mode": "qpos"}, 'have none of image_resolution, .* but action_mode: .*"openpi"'),
        ({}, "but nothing"),
        (SIX | {"n_external_cameras": 3}, "n_external_cameras = 3; allowed: 0, 1 or 2"),
        (SIX | {"n_external_cameras": True}, "n_external_cameras = True"),
        (SIX | {"needs_wrist_camera": 1}, "needs_wrist_camera = 1; allowed: true or false"),
        (SIX | {"image_resolution": 224}, "image_resolution = 224; allowed: .height, width."),
        (SIX | {"image_resolution": [0, 3]}, r"image_resolution = \[0, 3\]"),
        (
            SIX | {"action_space": "torque"},
            "action_space = 'torque'; allowed: joint_position, joint_velocity",
        ),
        (SIX | {"action_horizon": -1}, "action_horizon = -1"),
    ],
)
def test_metadata_of_another_protocol_or_without_sense_are_named(metadata: dict[str, Any], says: str) -> None:
    with (
        serving(answering(metadata, reply_to)) as url,
        policy_at(url) as policy,
        pytest.raises(PolicyError, match=says),
    ):
        policy.connect()


def test_missing_fields_have_the_defaults_of_the_fields_clients() -> None:
    asked: list[bytes] = []
    with (
        serving(answering({"action_space": "joint_position"}, reply_to, asked)) as url,
        policy_at(url) as policy,
    ):
        policy.infer(seen(FRANKA))
    request = msgpack_arrays.unpack(asked[0])
    assert request["observation/wrist_image_left"].shape == (224, 224, 3)
    assert "session_id" not in request


@pytest.mark.parametrize(
    ("settings", "size"),
    [({}, (48, 64)), ({"image_size": [20, 30]}, (20, 30)), ({"resize": "droid"}, (288, 512))],
)
def test_a_server_that_asks_for_no_size_gets_ours_or_the_cameras(
    settings: dict[str, Any], size: tuple[int, int]
) -> None:
    request = request_of(metadata={"image_resolution": None}, **settings)
    assert request["observation/wrist_image_left"].shape == (*size, 3)


def test_grippers_are_shown_as_droid_counts_them() -> None:
    qpos = np.array([*np.linspace(0, 0.6, 7), 0.75], np.float32)
    request = request_of(seen(FRANKA, qpos=qpos))
    assert request["observation/gripper_position"] == pytest.approx([0.25])
    assert request_of(seen(FRANKA, qpos=qpos), gripper="robot")["observation/gripper_position"] == [
        np.float32(0.75)
    ]
    np.testing.assert_array_equal(request["observation/joint_position"], qpos[:7])
    beyond = np.append(qpos[:7], np.float32(1.01))
    assert request_of(seen(FRANKA, qpos=beyond))["observation/gripper_position"] == [0.0]


def test_a_robot_of_two_arms_has_all_joints_and_all_grippers() -> None:
    request = request_of(robot=PIPER)
    assert request["observation/joint_position"].shape == (12,)
    assert request["observation/gripper_position"].shape == (2,)
    assert request["observation/cartesian_position"].shape == (12,)


def test_the_pose_is_shown_as_droid_writes_it_or_as_zeros() -> None:
    shown = seen(FRANKA)
    assert shown.eef is not None
    pose = request_of(shown)["observation/cartesian_position"]
    expected = Rotation.from_quat(shown.eef[3:7], scalar_first=True).as_euler("xyz")
    np.testing.assert_allclose(pose, [*shown.eef[:3], *expected], atol=1e-5)
    assert not request_of(shown, cartesian_position="zeros")["observation/cartesian_position"].any()
    with pytest.raises(PolicyError, match=r'allowed: policy.cartesian_position = "zeros"'):
        request_of(dataclasses.replace(shown, eef=None))


def test_a_missing_picture_is_named() -> None:
    with pytest.raises(PolicyError, match="no picture 'cam_left_wrist'; it has cam_high"):
        request_of(seen(FRANKA, pictures={"cam_high": np.zeros((8, 8, 3), np.uint8)}))


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"cameras": {"cam_low": "first"}}, "policy.cameras names cam_low; cameras of dual_franka: cam_high"),
        ({"cameras": {"cam_high": "first", "cam_left_wrist": "first"}}, "two cameras into one slot"),
        ({"action_space": "joint_velocity"}, "without policy.velocity_steps"),
        (
            {
                "action_space": "cartesian_velocity",
                "velocity_steps": {},
                "action_pose": PoseFormat(orientation="6d"),
            },
            "three turning speeds",
        ),
        ({"api_key_env": "SURELY_NOT_SET"}, "SURELY_NOT_SET, which is not set"),
    ],
)
def test_settings_that_do_not_fit_are_refused_before_anything_is_connected(
    settings: dict[str, Any], says: str
) -> None:
    with pytest.raises(ConfigurationError, match=says):
        built(**settings)


# What an answer means


def answered(rows: object, metadata: dict[str, Any] | None = None, **settings: Any) -> Any:
    with (
        serving(answering(SIX | (metadata or {}), lambda m: rows)) as url,
        policy_at(url, **settings) as policy,
    ):
        return policy.infer(seen(FRANKA))


def test_joint_positions_are_targets_and_grippers_are_turned_round() -> None:
    rows = np.zeros((3, 8), np.float32)
    rows[:, 7] = [0.0, 0.25, 1.2]
    chunk = answered(rows)
    assert (chunk.space, chunk.mode, chunk.rate) == ("joint", "absolute", None)
    np.testing.assert_allclose(chunk.actions[:, 7], [1.0, 0.75, 0.0])
    np.testing.assert_array_equal(answered(rows, gripper="robot").actions, rows)


def test_joint_velocities_are_shares_of_a_step_from_row_to_row() -> None:
    rows = np.full((3, 8), 0.5, np.float32)
    rows[1, :7] = [2, -2, 1, 0, 0, 0, 0]
    settings = {"action_space": "joint_velocity", "velocity_steps": {}, "action_rate": 15.0}
    chunk = answered(rows, {"action_space": "joint_velocity"}, **settings)
    assert (chunk.space, chunk.mode, chunk.rate) == ("joint", "delta", 15.0)
    np.testing.assert_allclose(chunk.actions[0], [*[0.1] * 7, 0.5], atol=1e-6)
    np.testing.assert_allclose(chunk.actions[1, :4], [0.2, -0.2, 0.2, 0], atol=1e-6)


def test_cartesian_rows_are_poses_with_euler_angles() -> None:
    rows = np.array([[0.4, 0.1, 0.3, 0.1, 0.2, 0.3, 1.0]])
    chunk = answered(rows, {"action_space": "cartesian_position"}, action_space="cartesian_position")
    assert (chunk.space, chunk.mode, chunk.pose) == ("eef", "absolute", PoseFormat(orientation="euler"))
    np.testing.assert_allclose(chunk.actions, [[0.4, 0.1, 0.3, 0.1, 0.2, 0.3, 0.0]], atol=1e-6)


def test_cartesian_velocities_keep_their_direction_and_are_never_longer_than_a_step() -> None:
    rows = np.array([[1, 0, 0, 0, 0.5, 0, 0], [0, 3, 4, 2, 0, 0, 0]], np.float32)
    settings = {
        "action_space": "cartesian_velocity",
        "velocity_steps": {"linear": 0.1, "angular": 0.2},
    }
    chunk = answered(rows, {"action_space": "cartesian_velocity"}, **settings)
    assert chunk.mode == "delta"
    expected = [[0.1, 0, 0, 0, 0.1, 0, 1.0], [0, 0.06, 0.08, 0.2, 0, 0, 1.0]]
    np.testing.assert_allclose(chunk.actions, expected, atol=1e-6)


@pytest.mark.parametrize("wrapped", [False, True])
@pytest.mark.parametrize("where", ["configured", "said"])
def test_an_answer_in_parts_is_joined_in_the_order_that_is_named(wrapped: bool, where: str) -> None:
    parts = {"gripper": ROWS[None, :, 7:], "arm": ROWS[None, :, :7]}
    names = ["arm", "gripper"]
    said = {"action_keys": names} if where == "said" else {}
    settings = {"action_keys": names} if where == "configured" else {}
    chunk = answered({"actions": parts} if wrapped else parts, said, gripper="robot", **settings)
    np.testing.assert_array_equal(chunk.actions, ROWS)


@pytest.mark.parametrize(
    ("reply", "settings", "says"),
    [
        ({"arm": ROWS}, {}, r"has no 'actions' but arm; .* \(none\)"),
        ({"arm": ROWS}, {"action_keys": ["arm", "gripper"]}, "parts named in policy.action_keys"),
        (
            {"arm": ROWS[:, :7], "gripper": ROWS[:1, 7:]},
            {"action_keys": ["arm", "gripper"]},
            "different numbers of rows: arm 2, gripper 1",
        ),
        ({"actions": [[1.0]]}, {}, "actions is a list"),
        (7, {}, "actions is a int"),
        (ROWS[:, :7], {}, "rows of 7 numbers; this robot needs 8"),
        (np.stack([ROWS, ROWS]), {}, r"shape \[2, 2, 8\]"),
        ({"actions": np.full((2, 8), np.nan)}, {}, "nan at row 0, column 0"),
        (b"\xc1", {}, "not the RoboArena protocol"),
        ("reset successful", {}, "reports an error: reset successful"),
    ],
)
def test_an_answer_that_is_none_is_named(reply: object, settings: dict[str, Any], says: str) -> None:
    with pytest.raises(PolicyError, match=says):
        answered(reply, **settings)


def test_conditioning_is_refused_because_the_protocol_has_no_place_for_it() -> None:
    with policy_at("ws://127.0.0.1:9") as policy, pytest.raises(PolicyError, match="no real-time chunking"):
        policy.infer(seen(FRANKA), Conditioning(np.zeros((2, 8), np.float32), 1, 0, 2))


# Sessions


def test_each_run_has_a_session_of_its_own_which_is_ended_on_the_server() -> None:
    with served() as (server, url), policy_at(url) as policy:
        policy.connect()
        policy.reset()  # nothing was asked: nothing to end
        for _ in range(2):
            policy.infer(seen(FRANKA))
            policy.infer(seen(FRANKA))
            policy.reset()
            policy.reset()
    first, second = server.heard.calls[:3], server.heard.calls[3:]
    assert [call[0] for call in first] == ["infer", "infer", "reset"]
    assert len({session for _, session in first}) == len({session for _, session in second}) == 1
    assert first[0][1] != second[0][1]
    assert server.heard.frames == {}


def test_the_end_of_a_rollout_ends_its_session_on_the_server_once() -> None:
    with served() as (server, url), policy_at(url) as policy:
        policy.end_episode()  # nothing was begun
        policy.infer(seen(FRANKA))
        policy.end_episode()
        assert server.heard.frames == {}
        policy.end_episode()
        policy.reset()
        policy.infer(seen(FRANKA))
    assert [call[0] for call in server.heard.calls] == ["infer", "reset", "infer"]
    (_, one), (_, ended), (_, other) = server.heard.calls
    assert one == ended != other


def test_no_connection_is_opened_to_end_a_session_and_the_next_request_ends_it() -> None:
    with served() as (server, url), policy_at(url) as policy:
        policy.infer(seen(FRANKA))
        policy._link.drop()
        policy.end_episode()
        assert not policy._link.is_open
        policy.infer(seen(FRANKA))
    assert [call[0] for call in server.heard.calls] == ["infer", "reset", "infer"]
    assert len({session for _, session in server.heard.calls[:2]}) == 1


def test_an_end_that_is_not_acknowledged_is_an_error_and_owed() -> None:
    answers = iter([ROWS, {"type": "error", "message": "no such session"}, "reset successful", ROWS])
    asked: list[bytes] = []
    with serving(answering(SIX, lambda m: next(answers), asked)) as url, policy_at(url) as policy:
        policy.infer(seen(FRANKA))
        with pytest.raises(PolicyError, match="no such session"):
            policy.end_episode()
        policy.infer(seen(FRANKA))
    sent = [msgpack_arrays.unpack(request)["endpoint"] for request in asked]
    assert sent == ["infer", "reset", "reset", "infer"]


def test_a_server_without_sessions_is_told_of_none() -> None:
    with served(session=False) as (server, url), policy_at(url) as policy:
        policy.infer(seen(FRANKA))
        policy.reset()
    assert server.heard.calls == [("infer", None), ("reset", None)]


@pytest.mark.parametrize(
    ("answer", "says"),
    [
        ("Traceback\nKeyError: 'session_id'", "reports an error: KeyError: 'session_id'"),
        ("reset succesful", "reports an error: reset succesful"),
        ({"type": "error", "message": "no such session"}, "reports an error: no such session"),
        ({"actions": ROWS}, r"answered a reset with a dict \(actions\)"),
        (ROWS, "answered a reset with a ndarray"),
    ],
)
def test_a_reset_that_is_not_acknowledged_is_an_error_and_owed(answer: object, says: str) -> None:
    answers = iter([ROWS, answer, "reset successful", ROWS])
    asked: list[bytes] = []
    with serving(answering(SIX, lambda m: next(answers), asked)) as url, policy_at(url) as policy:
        policy.infer(seen(FRANKA))
        with pytest.raises(PolicyError, match=says):
            policy.reset()
        policy.infer(seen(FRANKA))
    sent = [msgpack_arrays.unpack(request) for request in asked]
    assert [message["endpoint"] for message in sent] == ["infer", "reset", "reset", "infer"]
    assert sent[0]["session_id"] == sent[1]["session_id"] == sent[2]["session_id"] != sent[3]["session_id"]


def test_a_mute_reset_times_out_and_its_late_acknowledgement_is_never_an_answer() -> None:
    def converse(connection: ServerConnection) -> None:
        connection.send(msgpack_arrays.pack(SIX))
        for number, request in enumerate(connection):
            if msgpack_arrays.unpack(request)["endpoint"] == "infer":
                connection.send(msgpack_arrays.pack(ROWS))
            elif conversations:
                connection.send("reset successful")
            else:
                conversations.append(number)

    conversations: list[int] = []
    with serving(converse) as url, policy_at(url, reset_deadline=0.1) as policy:
        policy.infer(seen(FRANKA))
        with pytest.raises(PolicyTimeout, match=r"did not send an acknowledgement within 0\.1 s"):
            policy.reset()
        assert policy.infer(seen(FRANKA)).actions.shape == (2, 8)


def test_a_connection_that_the_server_ended_while_nobody_asked_is_opened_anew() -> None:
    """As vLLM-Omni does it after half a minute."""
    with served(idle=0.05) as (server, url), policy_at(url) as policy:
        policy.connect()
        while not policy._link.closed_by_peer:
            assert policy._link.is_open
        server._idle = None  # the next connection is left alone, however slow this machine is
        assert policy.infer(seen(FRANKA)).actions.shape == (24, 8)
    assert [call[0] for call in server.heard.calls] == ["infer"]


# The stand-ins


@pytest.mark.parametrize("reply", ["dict", "bare", "parts"])
@pytest.mark.parametrize("variant", ["roboarena", "vllm"])
def test_the_bundled_server_answers_with_rows_that_begin_where_the_robot_is(reply: str, variant: str) -> None:
    settings = {"action_keys": ["arm", "gripper"]} if reply == "parts" else {}
    with served(reply=reply, variant=variant) as (_, url), policy_at(url, **settings) as policy:
        for value in (0.1, 0.4):
            chunk = policy.infer(seen(FRANKA, value))
            assert np.abs(chunk.actions[0] - np.clip(value, FRANKA.lower, FRANKA.upper)).max() < 0.05
        policy.reset()
        policy.infer(seen(FRANKA))


def test_velocities_of_the_bundled_server_lead_where_its_positions_do() -> None:
    settings = {"action_space": "joint_velocity", "velocity_steps": {}}
    with served() as (_, url), policy_at(url) as policy:
        targets = policy.infer(seen(FRANKA)).actions
    with served(space="joint_velocity") as (_, url), policy_at(url, **settings) as policy:
        steps = policy.infer(seen(FRANKA)).actions
    np.testing.assert_allclose(0.1 + np.cumsum(steps[:, :7], axis=0), targets[:, :7], atol=1e-4)


def test_vllm_omni_is_reached_by_its_path_alone() -> None:
    with served(variant="vllm") as (_, url):
        assert url.endswith("/v1/realtime/robot/openpi")
        with (
            policy_at(url.removesuffix("/v1/realtime/robot/openpi")) as policy,
            pytest.raises(PolicyError, match="HTTP 404"),
        ):
            policy.connect()


def test_a_server_that_has_no_robot_policy_says_so_in_json() -> None:
    with (
        served(variant="vllm", fault=Fault("not_loaded")) as (_, url),
        policy_at(url) as policy,
        pytest.raises(PolicyError, match=r"reports an error: Robot policy not available, unsupported$"),
    ):
        policy.connect()


def test_a_server_that_expects_the_other_numbering_says_so_here_and_would_not_in_the_field() -> None:
    with (
        served(numbering=1) as (_, url),
        policy_at(url) as policy,
        pytest.raises(PolicyError, match="exterior_image_1_left"),
    ):
        policy.infer(seen(FRANKA))


def test_a_traceback_ends_the_connection_and_the_next_request_opens_another() -> None:
    with served(fault=Fault("exception")) as (_, url), policy_at(url) as policy:
        for _ in range(2):
            with pytest.raises(PolicyError, match="RuntimeError: CUDA out of memory") as raised:
                policy.infer(seen(FRANKA))
            assert not isinstance(raised.value, PolicyDisconnected)
