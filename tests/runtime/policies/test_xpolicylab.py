from __future__ import annotations

import contextlib
import dataclasses
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosedOK
from websockets.sync.server import ServerConnection

import robots
from runtime.core.clock import MonotonicClock
from runtime.core.errors import (
    ActionSpaceError,
    ConfigurationError,
    NotFiniteError,
    PolicyError,
    PolicyTimeout,
    ServerReportedError,
    ShapeError,
    WrongProtocolError,
)
from runtime.core.pose_format import PoseFormat
from runtime.core.types import Conditioning
from runtime.policies import xpolicylab
from runtime.policies.groot import arrays
from runtime.policies.xpolicy.envelope import Request
from runtime.policies.xpolicylab import Config, XpolicylabPolicy
from runtime.standins.faults import NONE, Fault
from runtime.standins.xpolicylab_server import XpolicylabBehaviour, XpolicylabServer
from tests.processes import PATIENCE_S, eventually, joined
from tests.runtime.policies.peers import FRANKA, PIPER, Handler, seen, serving

VECTORS = Path(__file__).parents[1] / "vectors"
ARM = robots.load_robot("agilex_piper", ["left_arm"])
HUMANOID = robots.load_robot("agibot_g2")  # two arms, a head and a torso
ONE = {"cam_high": "cam_head", "cam_left_wrist": "cam_wrist"}
TWO = {"cam_high": "cam_head", "cam_left_wrist": "cam_left_wrist", "cam_right_wrist": "cam_right_wrist"}
POSES = {"action_space": "eef", "observation_space": "eef"}
TURN = np.array([0.1, 0.2, 0.3, 0.5, 0.5, 0.5, 0.5], np.float32)  # x, y, z, qw, qx, qy, qz


def built(robot: Any = FRANKA, **settings: Any) -> XpolicylabPolicy:
    cameras = ONE if len(robot.arms) == 1 else TWO
    config = Config(**{"connect_deadline": 10.0, "cameras": cameras, "heartbeat_every": 0, **settings})
    return xpolicylab.build(config, robot, MonotonicClock(), 30.0)


@contextlib.contextmanager
def policy_at(url: str, robot: Any = FRANKA, **settings: Any) -> Iterator[XpolicylabPolicy]:
    with contextlib.closing(built(robot, url=url, **settings)) as policy:
        yield policy


@contextlib.contextmanager
def served(robot: Any = FRANKA, fault: Fault = NONE, **lab: Any) -> Iterator[tuple[XpolicylabServer, str]]:
    server = XpolicylabServer(robot, XpolicylabBehaviour(fault=fault, **lab))
    with contextlib.closing(server):
        yield server, str(server.start()["url"])


def reply(message: dict[str, Any], kind: str = "", /, **payload: Any) -> dict[str, Any]:
    """What the original answers to a message."""
    kinds = {
        "hello": "hello_ack",
        "reset": "reset_result",
        "infer": "infer_result",
        "trial_end": "trial_end_ack",
    }
    own = kind or kinds.get(message["message_type"], f"{message['message_type']}_ack")
    return message | {"message_type": own, "payload": payload or {"ok": True}}


def answering(infer: Callable[[dict[str, Any]], list[Any]], heard: list[str] | None = None) -> Handler:
    """Acknowledges everything; to an infer it sends what `infer` makes of it."""

    def converse(connection: ServerConnection) -> None:
        for request in connection:
            message = arrays.unpack(request, 2**24)
            if heard is not None:
                heard.append(message["message_type"])
            for sent in infer(message) if message["message_type"] == "infer" else [reply(message)]:
                connection.send(sent if isinstance(sent, str | bytes) else arrays.pack(sent, mnp=True))

    return converse


def step(value: float = 0.5, **more: Any) -> dict[str, Any]:
    joints, gripper = np.full(7, value, np.float32), np.full(1, value, np.float32)
    return {"arm_joint_state": joints, "ee_joint_state": gripper, **more}


# The bytes that XPolicyLab's own programs have written


def test_a_request_is_the_recorded_one_byte_for_byte() -> None:
    pixels = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
    qpos = np.array([0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.0], np.float32)
    shown = seen(ARM, qpos=qpos, pictures={"cam_high": pixels}, prompt="pick")
    observation = built(ARM, cameras={"cam_high": "cam_head"})._layout.observation(shown)
    made = Request(
        "infer", "eva-web", {"observation": observation}, "t1", 2, "m1", "2026-11-30T00:00:00+00:00"
    )
    assert arrays.pack(made.to_dict(), mnp=True) == (VECTORS / "xpolicylab_infer_request.bin").read_bytes()


def test_the_recorded_answer_is_understood_and_its_duration_a_numpy_scalar() -> None:
    policy, asked = built(ARM, cameras={"cam_high": "cam_head"}), Request("infer", "eva-web", {}, number="m1")
    message = policy._decode((VECTORS / "xpolicylab_infer_reply.bin").read_bytes(), "an answer")
    assert asked.is_answered_by(message)
    payload = asked.read(message)
    rows = policy._layout.rows(payload["actions"])
    np.testing.assert_array_equal(rows, np.arange(14, dtype=np.float32).reshape(2, 7) / 8)
    assert xpolicylab._latency(payload) == {"latency_ms": 1.5}


def test_the_recorded_error_is_told_with_its_code() -> None:
    message = built()._decode((VECTORS / "xpolicylab_error.bin").read_bytes(), "an answer")
    with pytest.raises(ServerReportedError, match="error in infer: infer_failed: Missing key 'joint_state'"):
        Request("infer", "eva-web", {}, number="m1").read(message)


# What is sent


def test_two_arms_are_sent_under_their_sides_and_pictures_in_their_slots() -> None:
    shown = seen(PIPER, qpos=np.arange(14, dtype=np.float32) / 100)
    observation = built(PIPER, **POSES)._layout.observation(shown)
    state = observation["state"]
    assert {key: view["color"].max() for key, view in observation["vision"].items()} == {
        "cam_head": 0,
        "cam_left_wrist": 1,
        "cam_right_wrist": 2,
    }
    np.testing.assert_array_equal(state["right_arm_joint_state"], shown.qpos[7:13])
    np.testing.assert_array_equal(state["right_ee_joint_state"], shown.qpos[13:])
    assert shown.eef is not None
    for side, start in (("left", 0), ("right", 8)):
        pose, own = state[f"{side}_ee_pose"], shown.eef[start : start + 7]
        np.testing.assert_allclose(pose * np.sign(pose[3]), own * np.sign(own[3]), atol=1e-6)
    assert observation["additional_info"] == {"frequency": 30.0}
    assert observation["instruction"] == "pick the block"


@pytest.mark.parametrize(
    ("settings", "keys"),
    [
        ({}, ["arm_joint_state", "ee_joint_state"]),
        ({"single_arm_joints": "joint_state"}, ["joint_state", "ee_joint_state"]),
        ({"arms": {"left_arm": "right"}}, ["right_arm_joint_state", "right_ee_joint_state"]),
        ({"observation_space": "eef"}, ["arm_joint_state", "ee_joint_state", "ee_pose"]),
    ],
)
def test_the_names_of_a_single_arm_are_the_declared_ones(settings: dict[str, Any], keys: list[str]) -> None:
    assert list(built(**settings)._layout.observation(seen(FRANKA))["state"]) == keys


def test_pictures_get_the_declared_size_and_grippers_the_declared_convention() -> None:
    observation = built(image_size=[24, 32], gripper="droid")._layout.observation(seen(FRANKA))
    assert observation["vision"]["cam_head"]["color"].shape == (24, 32, 3)
    assert observation["vision"]["cam_head"]["shape"] == [24, 32]
    assert observation["state"]["ee_joint_state"] == pytest.approx([0.9])  # 1 is open for the robot


@pytest.mark.parametrize(
    ("robot", "settings", "says"),
    [
        (FRANKA, {"cameras": {}}, r"policy.cameras = \{\}; allowed: a slot for each view .* cam_high"),
        (FRANKA, {"cameras": {"cam_high": "cam_head", "cam_left_wrist": "cam_head"}}, "no slot twice"),
        (FRANKA, {"cameras": {"cam_low": "cam_head"}}, "policy.cameras names cam_low"),
        (PIPER, {"arms": {"left_arm": "left"}}, "allowed: each of left_arm, right_arm once"),
        (PIPER, {"arms": {"left_arm": "left", "right_arm": "left"}}, "with different sides"),
        (FRANKA, {"action_pose": PoseFormat(orientation="6d")}, "joint"),
        (FRANKA, POSES | {"action_pose": PoseFormat(orientation="xyzw")}, "allowed: orientation = 'wxyz'"),
        (FRANKA, POSES | {"observation_pose": PoseFormat(orientation="6d")}, "policy.observation_pose is 6d"),
        (HUMANOID, {"cameras": {"top_head": "cam_head"}}, "'joint' has no key for head, body .*: arms alone"),
    ],
)
def test_settings_that_do_not_fit_are_refused_before_anything_is_connected(
    robot: Any, settings: dict[str, Any], says: str
) -> None:
    with pytest.raises(ConfigurationError, match=says):
        built(robot, **settings)


def test_what_is_no_arm_is_held_where_actions_are_poses() -> None:
    policy = built(HUMANOID, cameras={"top_head": "cam_head"}, **POSES)
    assert set(policy._layout.observation(seen(HUMANOID))["state"]) == {
        f"{side}_{key}"
        for side in ("left", "right")
        for key in ("arm_joint_state", "ee_joint_state", "ee_pose")
    }
    assert max(max(dims) for dims in policy._layout.actions.values()) == 15


def test_arms_whose_names_tell_no_side_must_be_declared() -> None:
    first, second = (
        dataclasses.replace(group, name=name)
        for group, name in zip(PIPER.groups, ("arm_a", "arm_b"), strict=True)
    )
    robot = dataclasses.replace(PIPER, groups=(first, second))
    with pytest.raises(ConfigurationError, match="arm_a, arm_b do not tell which arm is left"):
        built(robot)
    policy = built(robot, arms={"arm_a": "right", "arm_b": "left"})
    assert next(iter(policy._layout.actions)) == "right_arm_joint_state"


def test_the_sides_follow_the_names_whichever_arm_comes_first_also_at_the_stand_in() -> None:
    right, left = (
        dataclasses.replace(group, name=name)
        for group, name in zip(PIPER.groups, ("right_arm", "left_arm"), strict=True)
    )
    robot = dataclasses.replace(PIPER, groups=(right, left))
    actions = built(robot)._layout.actions
    assert actions["right_arm_joint_state"] == right.joint_dims.tolist()
    assert actions["left_arm_joint_state"] == left.joint_dims.tolist()
    assert XpolicylabServer(robot, XpolicylabBehaviour())._keys("arm_joint_state") == actions


# What an answer means


def test_joint_actions_are_rows_in_the_robots_order_under_either_name() -> None:
    under_other = {"joint_state": [0.25] * 7, "ee_joint_state": [0.5]}  # lists are numbers as well
    rows = built()._layout.rows([step(0.5), under_other])
    np.testing.assert_array_equal(rows, [[0.5] * 8, [*[0.25] * 7, 0.5]])
    assert rows.dtype == np.float32


def test_grippers_of_an_answer_are_in_the_declared_convention() -> None:
    rows = built(gripper="droid")._layout.rows([step(0.25)])
    assert rows[0, -1] == pytest.approx(0.75)


def test_pose_actions_are_wxyz_with_the_gripper_after_each() -> None:
    actions = [{"ee_pose": TURN, "ee_joint_state": np.ones(1, np.float32)}]
    policy = built(**POSES)
    chunk = policy._config.chunk(policy._layout.rows(actions), {})
    np.testing.assert_array_equal(chunk.actions, [[*TURN, 1.0]])
    assert chunk.pose is not None
    assert (chunk.space, chunk.mode, chunk.pose.orientation) == ("eef", "absolute", "wxyz")


@pytest.mark.parametrize("mode", ["delta", "relative"])
def test_changes_of_poses_are_taken_where_they_are_declared(mode: str) -> None:
    actions = [{"delta_ee_pose": TURN, "ee_joint_state": np.ones(1, np.float32)}]
    policy = built(**POSES, action_mode=mode)
    assert policy._config.chunk(policy._layout.rows(actions), {}).mode == mode
    with pytest.raises(ActionSpaceError, match=f"no delta_ee_pose .* policy.action_mode = '{mode}'"):
        policy._layout.rows([{"ee_pose": TURN, "ee_joint_state": np.ones(1)}])


@pytest.mark.parametrize(
    ("actions", "error", "says"),
    [
        (None, ShapeError, "actions is a NoneType; expected a list"),
        ([], ShapeError, "actions is empty"),
        ([{}] * 10_001, ShapeError, "actions has 10001 steps; expected at most 10000"),
        (np.zeros((2, 8)), ShapeError, "actions is a ndarray"),
        ([[step()]], ShapeError, "step 0 of actions is a list; expected a map with arm_joint_state"),
        ([step(), {"arm_joint_state": np.zeros(7)}], ShapeError, "step 1 of actions has no ee_joint_state"),
        ([step(torso=np.zeros(1))], ShapeError, "the unexpected torso; expected .*policy.ignored_actions"),
        ([step(ee_pose=TURN)], ActionSpaceError, "unexpected ee_pose.*policy.action_space = 'joint'"),
        ([step(left_arm_joint_state=np.zeros(7))], ActionSpaceError, "correct them, policy.arms"),
        ([step(delta_ee_pose=TURN)], ActionSpaceError, "change poses.*allowed .* 'eef' with 'delta'"),
        (
            [step(arm_joint_state=np.zeros(6))],
            ShapeError,
            r"'arm_joint_state' of step 0 .*\[6\]; .* needs \[7\]",
        ),
        ([step(ee_joint_state=np.zeros((1, 1)))], ShapeError, r"the shape \[1, 1\]"),
        ([step(ee_joint_state=0.5)], ShapeError, "a float that is no array of numbers; expected 1 numbers"),
        ([step(ee_joint_state=["open"])], ShapeError, "a list that is no array of numbers"),
        ([step(arm_joint_state=[[1.0], 2.0])], ShapeError, "a list that is no array of numbers"),
        (
            [step(), step(ee_joint_state=np.array([np.inf]))],
            NotFiniteError,
            "'ee_joint_state' has inf at row 1",
        ),
        ([step(ee_joint_state=np.array([1e300]))], NotFiniteError, "'ee_joint_state'"),
    ],
)
def test_actions_that_are_none_are_named(actions: object, error: type[PolicyError], says: str) -> None:
    with pytest.raises(error, match=says):
        built()._layout.rows(actions)


def test_a_key_that_the_robot_needs_may_not_be_listed() -> None:
    with pytest.raises(ConfigurationError, match=r"policy\.ignored_actions names arm_joint_state, which"):
        built(ignored_actions=["torso", "arm_joint_state"])


def test_a_key_without_use_may_be_listed() -> None:
    policy = built(ignored_actions=["delta_ee_pose", "torso"])
    assert policy._layout.rows([step(delta_ee_pose=TURN, torso=np.zeros(2))]).shape == (1, 8)


@pytest.mark.parametrize(
    ("sent", "error", "says"),
    [
        (lambda m: reply(m, latency_ms=1.0), WrongProtocolError, "no 'actions'; it has latency_ms"),
        (
            lambda m: reply(m, "reset_result"),
            WrongProtocolError,
            "message_type 'reset_result'; expected 'infer_re",
        ),
        (lambda m: m | {"payload": [1]}, WrongProtocolError, "payload that is a list"),
        (
            lambda m: reply(m) | {"message_type": np.zeros(2)},
            WrongProtocolError,
            "message_type that is a ndarray; expected a string",
        ),
        (
            lambda m: reply(m, "error", code="x", message=np.zeros(2), details=np.zeros(2)),
            ServerReportedError,
            r"in infer: x: \[0\. 0\.\]$",
        ),
        (
            lambda m: reply(m, "error", code="x", message="no", details={"trace": "z" * 9999}),
            ServerReportedError,
            r"in infer: x: no \(.{400}\)$",
        ),
        (lambda m: {"actions": []}, WrongProtocolError, "a map of actions; .* it is no XPolicyLab server"),
        (lambda m: [1], WrongProtocolError, "an answer to infer that is a list"),
        (lambda m: b"\xc1", WrongProtocolError, "not the XPolicyLab protocol"),
        (lambda m: "busy", ServerReportedError, "reports an error: busy"),
        (
            lambda m: reply(m, "error", code="infer_failed", message="no memory", details={"gpu": 0}),
            ServerReportedError,
            r"in infer: infer_failed: no memory \(\{'gpu': 0\}\)",
        ),
    ],
)
def test_an_answer_that_is_none_is_named(
    sent: Callable[[dict[str, Any]], Any], error: type[PolicyError], says: str
) -> None:
    with (
        serving(answering(lambda message: [sent(message)])) as url,
        policy_at(url) as policy,
        pytest.raises(error, match=says),
    ):
        policy.infer(seen(FRANKA))


def test_conditioning_is_refused_because_the_protocol_has_no_place_for_it() -> None:
    with policy_at("ws://127.0.0.1:9") as policy, pytest.raises(PolicyError, match="no real-time chunking"):
        policy.infer(seen(FRANKA), Conditioning(np.zeros((2, 8), np.float32), 1, 0, 2))


# The conversation


def test_a_run_is_a_trial_with_a_beginning_an_end_and_counted_steps() -> None:
    with served() as (server, url):
        with policy_at(url) as policy:
            assert policy.connect().name == "stand-in"
            policy.reset()
            for value in (0.1, 0.4):
                chunk = policy.infer(seen(FRANKA, value))
                assert np.abs(chunk.actions[0] - np.clip(value, FRANKA.lower, FRANKA.upper)).max() < 0.05
            policy.end_episode()
            policy.reset()
            policy.infer(seen(FRANKA))
        eventually(lambda: server.calls[-1][0] == "close", "the farewell")
    kinds, trials = zip(*server.calls, strict=True)
    assert kinds == ("hello", "reset", "infer", "infer", "trial_end", "reset", "infer", "close")
    assert trials[0] is None
    assert len(set(trials[1:5])) == len(set(trials[5:])) == 1
    assert trials[1] != trials[5]
    assert set(chunk.timing) == {"latency_ms", "round_trip_ms"}


def test_every_reset_resets_the_model_and_ends_a_trial_in_which_nothing_was_asked() -> None:
    """Another client may have used the model since, or the server is another."""
    with served() as (server, url), policy_at(url) as policy:
        policy.reset()
        policy.reset()
        policy.connect()
        policy.reset()
        policy.end_episode()
    kinds = [kind for kind, _ in server.calls if kind != "close"]
    again = ["trial_end", "reset"]
    assert kinds == ["hello", "reset", *again, "hello", *again, "trial_end"]


def test_a_trial_whose_connection_is_gone_is_ended_before_the_next_begins() -> None:
    with served() as (server, url), policy_at(url) as policy:
        policy.infer(seen(FRANKA))
        policy._link.drop()
        policy.end_episode()
        policy.infer(seen(FRANKA))
    kinds = [kind for kind, _ in server.calls if kind != "close"]
    assert kinds == ["hello", "reset", "infer", "hello", "trial_end", "reset", "infer"]


def test_a_lost_connection_is_greeted_again_and_the_trial_goes_on_without_a_repeated_request() -> None:
    with served(fault=Fault("close_mid_reply", "3")) as (server, url), policy_at(url) as policy:
        policy.infer(seen(FRANKA))
        with pytest.raises(PolicyError, match="closed the connection"):
            policy.infer(seen(FRANKA))
    kinds = [kind for kind, _ in server.calls]
    assert kinds == ["hello", "reset", "infer", "infer"]


def test_replies_to_other_messages_are_dropped_and_counted(caplog: pytest.LogCaptureFixture) -> None:
    before: list[dict[str, Any]] = []

    def infer(message: dict[str, Any]) -> list[Any]:
        own = reply(message, actions=[step(0.1 * (message["step"] + 1))])
        foreign = own | {"message_id": "another"}
        late, before[:] = list(before), [own]
        return [*late, foreign, own, own]

    with serving(answering(infer)) as url, policy_at(url) as policy:
        firsts = [policy.infer(seen(FRANKA)).actions[0, 0] for _ in range(3)]
    np.testing.assert_allclose(firsts, [0.1, 0.2, 0.3], rtol=1e-6)
    assert policy.dropped_replies == 3 + 2 * 2  # foreign ones; of the first two the copy, and once more late
    told = [line[-8:] for line in caplog.messages if "to no pending request, it is dropped" in line]
    assert told == ["1 so far", "2 so far", "5 so far"]  # once for each request


def test_a_server_that_answers_others_alone_is_silent_in_time() -> None:
    def infer(message: dict[str, Any]) -> list[Any]:
        return [reply(message | {"message_id": "another"}, actions=[step()])] * 50

    with (
        serving(answering(infer)) as url,
        policy_at(url, first_inference_deadline=0.2) as policy,
        pytest.raises(PolicyTimeout, match=r"did not send an answer to infer within 0\.2 s"),
    ):
        policy.infer(seen(FRANKA))


@pytest.mark.parametrize("kind", ["hello", "reset", "trial_end"])
def test_what_is_not_acknowledged_is_an_error(kind: str) -> None:
    def converse(connection: ServerConnection) -> None:
        for request in connection:
            message = arrays.unpack(request, 2**24)
            made = reply(message, actions=[step()]) if message["message_type"] == "infer" else reply(message)
            spoilt = message["message_type"] == kind
            connection.send(arrays.pack(reply(message, ok=False) if spoilt else made, mnp=True))

    def talk(policy: XpolicylabPolicy) -> None:
        policy.infer(seen(FRANKA))
        policy.end_episode()

    with (
        serving(converse) as url,
        policy_at(url) as policy,
        pytest.raises(ServerReportedError, match=f"answered {kind} with ok = False"),
    ):
        talk(policy)


def test_an_error_of_the_model_leaves_the_connection() -> None:
    with served(fault=Fault("refused")) as (server, url), policy_at(url) as policy:
        for _ in range(2):
            with pytest.raises(ServerReportedError, match="infer_failed: CUDA out of memory"):
                policy.infer(seen(FRANKA))
            assert policy._link.is_open
    assert [kind for kind, _ in server.calls].count("hello") == 1


def test_a_model_that_wants_the_other_name_says_so_and_gets_it() -> None:
    with served(single="joint_state") as (_, url):
        with (
            policy_at(url) as policy,
            pytest.raises(PolicyError, match="infer_failed: KeyError: 'joint_state'"),
        ):
            policy.infer(seen(FRANKA))
        with policy_at(url, single_arm_joints="joint_state") as policy:
            assert policy.infer(seen(FRANKA)).actions.shape == (16, 8)


@pytest.mark.parametrize(
    ("fault", "error", "says"),
    [
        ("missing_key", ShapeError, "step 0 of actions has no left_arm_joint_state"),
        ("unknown_key", ShapeError, "the unexpected gripper"),
        ("delta_key", ActionSpaceError, "the unexpected left_delta_ee_pose"),
        ("wrong_dim", ShapeError, "'left_arm_joint_state' of step 0"),
        ("nan", NotFiniteError, "'left_arm_joint_state' has nan at row 3, column 2"),
        ("malformed", WrongProtocolError, "not the XPolicyLab protocol"),
    ],
)
def test_a_fault_of_the_bundled_server_is_named(fault: str, error: type[PolicyError], says: str) -> None:
    with (
        served(PIPER, Fault(fault)) as (_, url),
        policy_at(url, PIPER) as policy,
        pytest.raises(error, match=says),
    ):
        policy.infer(seen(PIPER))


def test_heartbeats_go_out_while_nobody_asks_until_it_is_closed() -> None:
    enough = threading.Event()

    class Counted(list[str]):
        def append(self, kind: str) -> None:
            super().append(kind)
            if self.count("heartbeat") == 3:
                enough.set()

    heard = Counted()
    with serving(answering(lambda _: [], heard)) as url, policy_at(url, heartbeat_every=0.02) as policy:
        before = set(threading.enumerate())
        policy.connect()
        (thread,) = [one for one in set(threading.enumerate()) - before if one.name == "xpolicylab-ping"]
        assert enough.wait(PATIENCE_S)
        policy.close()
        joined(thread)
    assert heard[0] == "hello"


def test_a_server_is_left_with_the_message_close_and_a_close_frame() -> None:
    ended: list[Exception] = []
    heard: list[dict[str, Any]] = []

    def converse(connection: ServerConnection) -> None:
        try:
            while True:
                heard.append(arrays.unpack(connection.recv(), 2**24))
                if heard[-1]["message_type"] != "close":
                    connection.send(arrays.pack(reply(heard[-1]), mnp=True))
        except ConnectionClosedOK as closed:
            ended.append(closed)

    with serving(converse) as url, policy_at(url) as policy:
        policy.connect()
        policy.close()
        eventually(lambda: ended, "the end of the conversation")
    assert [message["message_type"] for message in heard] == ["hello", "close"]
    assert heard[-1]["payload"] == {"reason": "the client leaves"}
