from __future__ import annotations

import contextlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

import robots
from runtime.core.clock import VirtualClock
from runtime.core.errors import TransportError
from runtime.core.types import RobotCommand
from runtime.transports import ros2
from runtime.transports.ros import cdr
from runtime.transports.ros.messages import JointState, PoseStamped
from runtime.transports.ros.middleware import Deliver, Match, Middleware, Publish, Topic
from runtime.transports.ros.sink import RosSink
from runtime.transports.ros.topics import GroupTopics, Topics

ROBOT = robots.load_robot("r1_lite")
LEFT, RIGHT = "/motion_target/target_joint_state_arm_left", "/motion_target/target_joint_state_arm_right"
ACTION = np.linspace(-0.5, 0.8, 14).astype(np.float32)


class Wall(Middleware):
    """A middleware on which everything that is published stays."""

    def __init__(self) -> None:
        self.topics: dict[str, Topic] = {}
        self.sent: list[tuple[str, bytes]] = []
        self.found: dict[str, Match] = {}

    def subscribe(self, topic: Topic, deliver: Deliver) -> None:
        raise AssertionError("a sink listens to nothing")

    def advertise(self, topic: Topic) -> Publish:
        self.topics[topic.name] = topic
        return lambda payload: self.sent.append((topic.name, payload))

    def matches(self) -> Mapping[str, Match]:
        return {name: self.found.get(name, Match(1)) for name in self.topics}

    def close(self) -> None:
        self.topics.clear()

    def read(self) -> list[tuple[str, Any]]:
        return [(name, cdr.decode(self.topics[name].message, payload)) for name, payload in self.sent]


def connected(monkeypatch: pytest.MonkeyPatch, **settings: Any) -> tuple[RosSink, Wall, VirtualClock]:
    wall, clock = Wall(), VirtualClock(20.0)
    monkeypatch.setattr(ros2, "middleware", lambda *_: wall)
    sink = ros2.sink(ros2.Config(**settings), ROBOT, clock)
    sink._wall = lambda: 1_800_000_000_000_000_000
    sink.connect()
    return sink, wall, clock


def command(**changes: Any) -> RobotCommand:
    return RobotCommand(**({"action": ACTION, "step": 3, "time": 19.75} | changes))


def test_each_group_is_told_its_joints_with_the_same_stamp(monkeypatch: pytest.MonkeyPatch) -> None:
    sink, wall, _ = connected(monkeypatch)
    sink.send(command())
    told = dict(wall.read())
    assert len(told) == 4
    assert {message.stamp for message in told.values()} == {1_799_999_999_750_000_000}  # when it was made
    assert told[LEFT].names == ROBOT.groups[0].joints[:6]
    np.testing.assert_allclose(told[LEFT].position, ACTION[:6], rtol=1e-7)
    np.testing.assert_allclose(told[RIGHT].position, ACTION[7:13], rtol=1e-7)
    gripper = told["/motion_target/target_position_gripper_right"]
    assert isinstance(gripper, JointState)
    assert (gripper.names, gripper.position.tolist()) == (("right_gripper_joint",), [float(ACTION[13])])
    assert len(gripper.velocity) == len(gripper.effort) == 0


def test_commands_are_reliable_unless_a_topic_is_said_otherwise(monkeypatch: pytest.MonkeyPatch) -> None:
    _, wall, _ = connected(monkeypatch, qos={RIGHT: ros2.Quality(depth=3, reliability="best_effort")})
    assert (wall.topics[LEFT].quality.reliability, wall.topics[LEFT].quality.depth) == ("reliable", 1)
    assert (wall.topics[RIGHT].quality.reliability, wall.topics[RIGHT].quality.depth) == ("best_effort", 3)


def test_the_simulation_beside_the_robot_is_told_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    topics = Topics(
        groups={f"{side}_arm": GroupTopics(simulation=f"/sim/{side}") for side in ("left", "right")}
    )
    sink, wall, _ = connected(monkeypatch, topics=topics, commands_to=["robot", "simulation"])
    sink.send(command())
    told = wall.read()
    assert [name for name, _ in told[:2]] == ["/sim/left", "/sim/right"]
    np.testing.assert_allclose(told[0][1].position, ACTION[:7], rtol=1e-7)
    assert len({message.stamp for _, message in told}) == 1
    assert len(told) == 6


def test_a_simulation_alone_leaves_the_robot_untold(monkeypatch: pytest.MonkeyPatch) -> None:
    topics = Topics(
        groups={f"{side}_arm": GroupTopics(simulation=f"/sim/{side}") for side in ("left", "right")}
    )
    sink, wall, _ = connected(monkeypatch, topics=topics, commands_to=["simulation"])
    sink.send(command())
    assert {name for name, _ in wall.sent} == {"/sim/left", "/sim/right"}


def test_poses_are_sent_scalar_last_in_the_arms_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    topics = Topics(
        groups={
            f"{side}_arm": GroupTopics(eef_command=f"/pose/{side}", command="") for side in ("left", "right")
        }
    )
    sink, wall, _ = connected(monkeypatch, topics=topics, eef_commands=True)
    eef = np.array([1, 2, 3, 0.5, -0.5, 0.5, -0.5, 9] * 2, np.float32)
    sink.send(command(eef=eef))
    told = dict(wall.read())
    assert isinstance(told["/pose/left"], PoseStamped)
    assert told["/pose/left"].pose.tolist() == [1, 2, 3, -0.5, 0.5, -0.5, 0.5]
    assert told["/pose/left"].frame == "base_link"
    assert LEFT not in told
    assert told["/motion_target/target_position_gripper_left"].position.tolist() == [float(ACTION[6])]
    with pytest.raises(TransportError, match=r'needed: publication\.space = "eef"'):
        sink.send(command())


@pytest.mark.parametrize("action", [np.zeros(13, np.float32), np.full(14, np.nan, np.float32)])
def test_a_vector_that_no_robot_may_be_given_is_refused_whole(
    monkeypatch: pytest.MonkeyPatch, action: np.ndarray
) -> None:
    sink, wall, _ = connected(monkeypatch)
    with pytest.raises(TransportError, match="allowed: 14 finite numbers"):
        sink.send(command(action=action))
    assert wall.sent == []


def test_a_sink_that_is_not_connected_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    sink, _, _ = connected(monkeypatch)
    with contextlib.closing(sink):
        pass
    sink.close()
    with pytest.raises(TransportError, match="connect before sending"):
        sink.send(command())
    with pytest.raises(TransportError, match="takes no control words"):
        sink.send_control_word("scene_reset", {})


def test_who_does_not_hear_is_known_by_topic(monkeypatch: pytest.MonkeyPatch) -> None:
    sink, wall, _ = connected(monkeypatch)
    assert sink.missing_subscribers() == {}
    why = "a subscriber of it is incompatible in its reliability"
    wall.found = {LEFT: Match(0), RIGHT: Match(1, why)}
    assert sink.missing_subscribers() == {LEFT: "", RIGHT: why}
    sink.close()
    assert sink.missing_subscribers() == {}
