"""A leader on ROS topics, by a middleware whose messages come from the test's own hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import robots
from runtime.core.clock import VirtualClock
from runtime.core.errors import ConfigurationError
from runtime.teleoperators import ros1, ros2
from runtime.teleoperators.base import LeaderPose
from runtime.transports import ros2 as transport
from runtime.transports.ros import cdr
from runtime.transports.ros.messages import JointState
from runtime.transports.ros.middleware import Match
from tests.runtime.transports.ros.hand import FakeMiddleware

ROBOT = robots.load_robot("agilex_piper")
LEFT, RIGHT = (ROBOT.groups[index] for index in (0, 1))
BOTH = {LEFT.name: {"topic": "/leader/left"}, RIGHT.name: {"topic": "/leader/right"}}


class Bench:
    def __init__(self, monkeypatch: pytest.MonkeyPatch, **settings: Any) -> None:
        self.hand, self.clock = FakeMiddleware(), VirtualClock(10.0)
        monkeypatch.setattr(transport, "middleware", lambda *_: self.hand)
        config = ros2.Config.model_validate({"groups": BOTH, **settings})
        self.leader = ros2.build(config, ROBOT, self.clock)
        self.leader.connect()
        self.stamp = 0

    def say(self, topic: str, position: Any, names: tuple[str, ...] = LEFT.joints, stamp: int = 0) -> None:
        self.stamp += 1
        message = JointState(stamp or self.stamp, "", names, np.asarray(position, np.float64))
        self.hand.deliver[topic](cdr.encode(message))

    @property
    def newest(self) -> LeaderPose:
        assert self.leader.latest_pose is not None
        return self.leader.latest_pose


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    return Bench(monkeypatch)


def test_a_pose_is_there_when_every_arm_has_said_something_and_as_old_as_the_oldest(bench: Bench) -> None:
    bench.say("/leader/left", range(7))
    assert bench.leader.latest_pose is None
    bench.clock.advance(0.02)
    bench.say("/leader/right", range(7, 14), RIGHT.joints)
    assert bench.newest.joints.tolist() == list(range(14))
    assert bench.newest.arrived == 10.0


def test_joints_are_taken_by_their_names_and_further_ones_are_left_out(bench: Bench) -> None:
    bench.say("/leader/right", np.zeros(7), RIGHT.joints)
    bench.say("/leader/left", [*range(7, 0, -1), 99.0], (*reversed(LEFT.joints), "pedal"))
    assert bench.newest.joints[LEFT.slice].tolist() == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]


def test_arms_that_share_a_topic_are_told_apart_by_their_joints(monkeypatch: pytest.MonkeyPatch) -> None:
    names = {name: tuple(f"{name}_{joint}" for joint in LEFT.joints) for name in BOTH}
    both = {name: {"topic": "/leader/joint_states", "joints": list(joints)} for name, joints in names.items()}
    bench = Bench(monkeypatch, groups=both)
    bench.say("/leader/joint_states", range(14), (*names[RIGHT.name], *names[LEFT.name]))
    assert bench.newest.joints.tolist() == [*range(7, 14), *range(7)]


def test_an_old_message_that_a_publisher_keeps_is_not_taken_for_a_new_one() -> None:
    with pytest.raises(ConfigurationError, match="an old pose would count as a new one"):
        ros2.Config.model_validate({"groups": BOTH, "qos": {"durability": "transient_local"}})


def test_an_arm_that_is_not_led_has_no_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, groups={LEFT.name: {"topic": "/leader/left"}})
    bench.say("/leader/left", range(7))
    assert np.isnan(bench.newest.joints[RIGHT.slice]).all()
    assert np.isfinite(bench.newest.joints[LEFT.slice]).all()


def test_an_arm_that_falls_silent_or_repeats_itself_makes_the_leader_silent_and_is_named(
    bench: Bench,
) -> None:
    bench.hand.found = {"/leader/left": Match(1), "/leader/right": Match(0)}
    assert bench.leader.problem == "/leader/left: no new message; /leader/right has no publisher"
    for stamp in (5, 5, 5):
        bench.say("/leader/right", np.zeros(7), RIGHT.joints, stamp=stamp)
        bench.say("/leader/left", np.zeros(7))
        bench.clock.advance(0.1)
    assert bench.newest.arrived == 10.0
    assert bench.leader.problem == "/leader/right has no publisher"


@pytest.mark.parametrize(
    ("position", "names", "why"),
    [
        (range(6), LEFT.joints[:6], f"lack {LEFT.joints[6]}"),
        (range(6), (), "6 positions without names came; expected 7"),
        ([np.nan] * 7, LEFT.joints, "expected finite numbers"),
    ],
)
def test_what_cannot_be_used_is_said_and_moves_nothing(
    bench: Bench, position: Any, names: tuple[str, ...], why: str
) -> None:
    bench.say("/leader/right", np.zeros(7), RIGHT.joints)
    bench.say("/leader/left", position, names)
    assert bench.leader.latest_pose is None
    assert why in bench.leader.problem
    assert "/leader/left" in bench.leader.problem
    bench.say("/leader/left", np.zeros(7))
    assert bench.leader.latest_pose is not None
    assert "positions" not in bench.leader.problem


def test_bytes_that_are_no_message_are_said(bench: Bench) -> None:
    bench.hand.deliver["/leader/left"](b"\x00\x01\x00\x00nonsense")
    assert bench.leader.problem.startswith("/leader/left: ")


def test_it_begins_anew_and_ends(bench: Bench) -> None:
    bench.say("/leader/left", np.zeros(7))
    bench.say("/leader/right", np.zeros(7), RIGHT.joints)
    bench.leader.connect()
    assert bench.hand.closed
    assert bench.leader.latest_pose is None
    bench.say("/leader/left", np.ones(7))
    assert bench.leader.latest_pose is None
    bench.leader.close()
    bench.leader.close()


@pytest.mark.parametrize(
    ("groups", "why"),
    [
        ({}, "groups"),
        ({"third_arm": {"topic": "/a"}}, "third_arm not of agilex_piper; allowed: left_arm, right_arm"),
        ({LEFT.name: {"topic": "no slash"}}, "topic"),
        ({LEFT.name: {"topic": "/a", "joints": ["one"]}}, "allowed: 7 different names"),
    ],
)
def test_groups_that_do_not_fit_are_named(groups: dict[str, Any], why: str) -> None:
    with pytest.raises((ConfigurationError, ValueError), match=why):
        ros2.build(ros2.Config.model_validate({"groups": groups}), ROBOT, VirtualClock())


def test_a_group_without_a_topic_is_led_on_the_one_that_the_robot_names() -> None:
    bare = {LEFT.name: {}, RIGHT.name: {"topic": "/leader/right"}}
    own = ros1.build(ros1.Config.model_validate({"groups": bare}), ROBOT, VirtualClock())
    assert own.name == "the leader on /eva/hil/input_joint_state_arm_left, /leader/right"
    with pytest.raises(
        ConfigurationError, match=r"left_arm.topic is missing, and the robot's description names no"
    ):
        ros2.build(ros2.Config.model_validate({"groups": bare}), ROBOT, VirtualClock())  # its stack is ROS 1


def test_a_link_beyond_this_machine_has_to_be_asked_for() -> None:
    with pytest.raises(ConfigurationError, match=r"collection\.leader\.network"):
        ros2.Config.model_validate({"groups": BOTH, "network": "eth0"})
    with pytest.raises(ConfigurationError, match=r"collection\.leader\.master"):
        ros1.Config.model_validate({"groups": BOTH, "master": "http://10.0.0.7:11311"})
