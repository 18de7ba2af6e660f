"""Control and what a person does by hand, with every robot: other numbers, one arm, groups without grippers."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import robots
from robots import Robot
from runtime.core.errors import RuntimeFault
from runtime.core.types import Float64
from runtime.ipc.command_arguments import AimRequest, GripperRequest, Jog, MoveRequest
from runtime.ipc.messages import LockGrippers, encode
from runtime.kinematics.base import Kinematics
from runtime.motion.timeline import DimensionKinds
from runtime.processes.coordinator.manual.grippers import Grippers
from runtime.processes.coordinator.manual.targets import Targets
from runtime.safety.filter import Limits, SafetySettings
from runtime.spaces.conversion import ActionSpaces
from tests.runtime.tick_bench import PERIOD, Bench, following

EVERY = pytest.mark.parametrize("name", robots.robot_names())


def limits_of(robot: Robot) -> Limits:
    grippers, binary = (
        np.isin(np.arange(robot.dim), dims) for dims in (robot.gripper_dims, robot.binary_dims)
    )
    return Limits(
        robot.joint_names, robot.lower, robot.upper, robot.velocity, grippers, binary, robot.speed_dims
    )


def plan_of(robot: Robot) -> Any:
    settings = SimpleNamespace(safety=SafetySettings())
    return SimpleNamespace(
        robot=robot, limits=limits_of(robot), deployment=settings, dims=DimensionKinds(robot.binary_dims)
    )


def standing_at(robot: Robot, pose: Float64) -> Bench:
    """Control that has taken the robot over at a pose."""
    bench = Bench(limits=limits_of(robot), dims=DimensionKinds(robot.binary_dims))
    bench.measured = pose.astype(float)
    bench.run()
    return bench


@pytest.mark.some(4)
@EVERY
def test_control_goes_from_pose_to_pose_and_arrives(name: str) -> None:
    robot = robots.load_robot(name)
    bench = standing_at(robot, robot.poses["ready"])
    bench.say("motion", goal=robot.poses["home"])
    bench.run(600)
    assert [event.kind for event in bench.said()] == ["motion_done"]
    assert np.allclose(bench.sent[-1], robot.poses["home"], atol=1e-3)
    steps = np.abs(np.diff(bench.sent, axis=0))
    angles = ~limits_of(robot).grippers
    assert (steps[:, angles] <= 0.3 * robot.velocity[angles] * PERIOD * 1.06 + 1e-6).all()


@EVERY
def test_control_executes_a_policy_s_chunk_of_every_group_and_switches_binary_grippers_at_once(
    name: str,
) -> None:
    robot = robots.load_robot(name)
    ready = robot.poses["ready"]
    rows = np.tile(ready, (40, 1))
    rows += 0.005 * np.sin(np.arange(40) / 8)[:, None] * ~limits_of(robot).grippers
    rows = np.clip(rows, robot.lower, robot.upper)
    closed = [group.gripper.close for group in robot.groups if group.gripper is not None]
    rows[20:, list(robot.gripper_dims)] = closed
    bench = standing_at(robot, ready)
    following(bench, rows)
    bench.run(38)
    sent = bench.sent[-39:]
    angles = ~limits_of(robot).grippers
    assert np.allclose(sent[2:, angles], rows[2:39, angles], atol=2e-3)
    for dim in robot.binary_dims:
        assert set(sent[:, dim]) == {np.float32(ready[dim]), np.float32(rows[-1, dim])}
        assert sent[20, dim] == np.float32(rows[20, dim])
    assert [event for event in bench.said() if event.kind in ("refused", "refusals", "starved")] == []


@EVERY
def test_grippers_open_close_and_lock_in_their_own_units_and_nothing_else_does(name: str) -> None:
    robot = robots.load_robot(name)
    grippers, here = Grippers(plan_of(robot)), robot.poses["ready"].astype(float)
    having = [group for group in robot.groups if group.gripper is not None]
    shut = grippers.plan_request(GripperRequest(action="close"), here, free=False)
    assert np.isfinite(shut.locks).tolist() == np.isin(np.arange(robot.dim), robot.gripper_dims).tolist()
    for group in having:
        assert shut.locks[group.gripper_dim] == group.gripper.close  # type: ignore[union-attr]
    bench = standing_at(robot, here)
    bench.say("motion", goal=here)
    bench.run(3)
    bench.shared.rings["orders"].push(encode(LockGrippers(shut.locks)))
    bench.run(120)
    assert np.allclose(bench.sent[-1][list(robot.gripper_dims)], shut.locks[list(robot.gripper_dims)])
    others = np.setdiff1d(np.arange(robot.dim), robot.gripper_dims)
    assert np.allclose(bench.sent[-1][others], here[others], atol=1e-6)
    names = ", ".join(group.name for group in having)
    with pytest.raises(RuntimeFault, match=f"gripper: arm = 'tail'; {name} has grippers on {names}"):
        grippers.plan_request(GripperRequest(arm="tail", action="open"), here, free=True)


class Standing(Kinematics):
    """Has every end effector where forward kinematics has it, and solves for nothing."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot

    def forward(self, q: Float64) -> Float64:
        return np.stack([arm.pose(q) for arm in self._robot.arms], axis=-2)

    def solve(self, *_: Any, **__: Any) -> Any:
        raise AssertionError("nothing is to be solved")


@pytest.mark.some(4)
@EVERY
def test_poses_are_gone_to_by_name_and_an_arm_that_there_is_not_is_refused(name: str) -> None:
    robot = robots.load_robot(name)
    kinematics = Standing(robot)
    targets = Targets(plan_of(robot), ActionSpaces(robot, kinematics, 30.0), kinematics)
    home, ready = robot.poses["home"], robot.poses["ready"]
    aim = targets.aim(AimRequest(pose="ready"), home)
    assert np.array_equal(aim.joints, ready)
    assert aim.poses.shape == (8 * len(robot.arms),)
    assert np.array_equal(targets.motion_goal(MoveRequest(pose="home"), ready), home)
    assert np.array_equal(targets.motion_goal(MoveRequest(pose="ready"), home), ready)
    with pytest.raises(RuntimeFault, match=f"{name} has {', '.join(arm.name for arm in robot.arms)}"):
        targets.aim(AimRequest(jog=Jog(arm="tail")), home)


def test_an_endless_joint_goes_the_shorter_way_and_is_never_far_from_its_own_turn() -> None:
    limits = Limits(
        ("turntable",),
        np.array([-np.inf]),
        np.array([np.inf]),
        np.array([3.0]),
        np.zeros(1, bool),
        np.zeros(1, bool),
    )
    bench = Bench(limits=limits, dims=DimensionKinds(wrapping=(0,)))
    bench.measured = np.array([2 * np.pi - 0.2])
    bench.run()
    bench.say("motion", goal=np.array([0.1]))
    bench.run(60)
    assert "motion_done" in [event.kind for event in bench.said()]
    assert bench.sent[-1] == pytest.approx([2 * np.pi + 0.1], abs=1e-4)
    assert (np.diff(bench.sent[:, 0]) >= 0).all()
