"""Numbers that are speeds, those of a mobile base: whatever stops the robot brings them to 0."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import robots
from runtime.core.errors import RuntimeFault
from runtime.core.types import ActionChunk, Float64, Observation
from runtime.ipc.command_arguments import MoveRequest
from runtime.ipc.messages import LockGrippers, encode
from runtime.ipc.shared_state import EStop
from runtime.kinematics.base import IkResult, Kinematics
from runtime.motion.timeline import DimensionKinds
from runtime.motion.trajectories import Brake
from runtime.processes.coordinator.manual.targets import Targets
from runtime.safety.filter import Limits, RobotState, SafetyFilter, SafetySettings
from runtime.spaces.conversion import ActionSpaces
from tests.runtime.tick_bench import PERIOD, Bench, following

DRIVEN = Limits(
    ("arm.joint", "base.vx"),
    np.array([-2.0, -0.5]),
    np.array([2.0, 0.5]),
    np.array([3.0, 1.0]),
    np.zeros(2, bool),
    np.zeros(2, bool),
    (1,),
)
DRIVING = np.tile([0.0, 0.4], (60, 1))


@pytest.fixture
def bench() -> Bench:
    """A robot that drives at 0.4 m/s."""
    made = following(Bench(limits=DRIVEN), DRIVING)
    made.run(29)
    assert made.sent[-1][1] == pytest.approx(0.4)
    return made


def test_a_base_s_numbers_are_speeds_and_an_arm_s_are_not() -> None:
    robot = robots.load_robot("r1_lite", ["left_arm", "torso", "base"])
    assert [robot.joint_names[dim] for dim in robot.speed_dims] == ["base.vx", "base.vy", "base.wz"]
    assert all(robots.load_robot(name).speed_dims == () for name in robots.robot_names())


def test_braking_brings_a_speed_to_zero_at_its_own_rate_and_no_joint_elsewhere() -> None:
    q, velocity = np.array([0.5, -0.4]), np.array([0.0, 3.0])
    brake = Brake(q, velocity, np.full(2, 20.0), DRIVEN.lower, DRIVEN.upper, (1,), DRIVEN.velocity)
    assert brake.duration == pytest.approx(0.4)
    assert brake.at(0.1)[1] == pytest.approx(-0.3)
    assert brake.at(0.4).tolist() == [0.5, 0.0]
    assert brake.at(9.0).tolist() == [0.5, 0.0]


def test_a_hold_stops_the_base(bench: Bench) -> None:
    bench.say("hold", run=1)
    bench.run(30)
    speeds = bench.sent[:, 1]
    assert speeds[-1] == 0.0
    assert (np.diff(speeds[30:]) >= -1.0 * PERIOD - 1e-6).all()  # no harder than it may slow down


def test_running_out_of_actions_stops_the_base(bench: Bench) -> None:
    bench.run(60)
    assert bench.sent[-1][1] == 0.0


def test_a_refused_action_stops_the_base(bench: Bench) -> None:
    bench.chunk(2, np.tile([np.nan, 0.4], (60, 1)))
    bench.run(40)
    assert bench.sent[-1][1] == 0.0


def test_the_e_stop_stops_the_base_at_once_however_fast_it_is_measured(bench: Bench) -> None:
    bench.shared.set_estop(EStop.LATCHED)
    bench.moved_by_hand = np.array([0.0, 0.4])
    bench.run(5)
    assert (bench.sent[-5:, 1] == 0.0).all()
    bench.shared.set_estop(EStop.CLEAR)
    bench.run(20)
    assert bench.sent[-1][1] == 0.0


def test_an_e_stop_within_the_tick_stops_the_base(bench: Bench) -> None:
    bench.before_send = lambda: bench.shared.set_estop(EStop.LATCHED)
    bench.run()
    assert bench.sent[-1][1] == 0.0


def test_a_restarted_control_stops_the_base_that_its_predecessor_drove(bench: Bench) -> None:
    bench.tick = bench.new_tick()
    bench.run(20)
    assert bench.sent[-1][1] == 0.0
    assert bench.behaviour == "hold"


def test_a_base_that_drives_is_taken_over_standing() -> None:
    bench = Bench(limits=DRIVEN)
    bench.moved_by_hand = bench.measured = np.array([0.3, 0.4])
    bench.run()
    bench.say("motion", goal=np.array([0.5, np.nan]))
    bench.run(40)
    assert (bench.sent[:, 1] == 0.0).all()


def test_a_motion_of_ours_never_drives_a_base(bench: Bench) -> None:
    bench.say("motion", goal=np.array([0.2, 0.4]))
    bench.run(60)
    assert bench.sent[-1] == pytest.approx([0.2, 0.0], abs=1e-6)
    assert "motion_done" in [event.kind for event in bench.said()]


def test_a_speed_that_is_not_measured_yet_is_no_following_error_and_no_jump() -> None:
    judging = SafetyFilter(SafetySettings(following_error=0.1, jump=0.1), DRIVEN)
    where = RobotState(np.array([0.0, 0.45]), np.zeros(2), np.zeros(2), PERIOD)
    assert not judging.judge(np.array([0.0, 0.2]), where).refused
    assert judging.judge(np.array([0.2, 0.45]), where).refused


def test_a_base_does_not_drive_on_because_it_is_measured_driving_where_it_should_stand(bench: Bench) -> None:
    bench.say("hold", run=1)
    bench.run(30)
    bench.said()
    bench.moved_by_hand = np.array([0.0, 5.0])
    bench.run(10)
    assert (bench.sent[-10:, 1] == 0.0).all()
    assert bench.said() == []  # it is not taken for an arm that was moved


def test_a_speed_is_no_gripper_to_be_locked(bench: Bench) -> None:
    bench.shared.rings["orders"].push(encode(LockGrippers(np.array([np.nan, 0.4]))))
    bench.run()
    assert [event.text for event in bench.said("lock_refused")] == [
        "base.vx is no gripper: only grippers are locked"
    ]


def test_a_person_cannot_have_a_base_driven_by_a_motion_and_an_approach_leaves_it_standing() -> None:
    robot = robots.load_robot("r1_lite", ["left_arm", "base"])
    none = np.zeros(robot.dim, bool)
    grippers = np.isin(np.arange(robot.dim), robot.gripper_dims)
    limits = Limits(
        robot.joint_names, robot.lower, robot.upper, robot.velocity, grippers, none, robot.speed_dims
    )
    settings = SimpleNamespace(safety=SafetySettings())
    spec: Any = SimpleNamespace(robot=robot, limits=limits, deployment=settings, dims=DimensionKinds())
    unused: Any = None
    targets = Targets(spec, unused, unused)
    driving = robot.poses["home"].copy()
    driving[robot.speed_dims[0]] = 0.2
    with pytest.raises(
        RuntimeFault, match=r"move: base.vx = 0.2000 is a speed; allowed at the end of a motion: 0"
    ):
        targets.motion_goal(MoveRequest(joints=driving.tolist()), robot.poses["home"])
    assert np.array_equal(targets.check_motion("approach", driving, robot.poses["home"]), robot.poses["home"])


class StandingArms(Kinematics):
    """Has the arms where they are, whatever is asked."""

    def __init__(self, robot: robots.Robot) -> None:
        self._robot = robot

    def forward(self, q: Float64) -> Float64:
        return np.stack([arm.pose(q) for arm in self._robot.arms], axis=-2)

    def solve(self, targets: Float64, seed: Float64, *_: Any, **__: Any) -> IkResult:
        none = np.zeros(targets.shape[:2])
        return IkResult(np.tile(seed, (len(targets), 1)), none, none, none.astype(np.uint8))


def test_a_policy_in_poses_leaves_the_base_standing_and_one_in_steps_names_its_speed() -> None:
    robot = robots.load_robot("r1_lite", ["left_arm", "base"])
    spaces = ActionSpaces(robot, StandingArms(robot), 30.0)
    qpos = robot.poses["ready"].copy()
    qpos[list(robot.speed_dims)] = 0.3
    seen = Observation(1, 0.0, {}, qpos.astype(np.float32), {})
    made = spaces.to_command(ActionChunk(np.tile(spaces.eef_of(qpos), (5, 1)), space="eef"), seen)
    assert (made.rows[:, list(robot.speed_dims)] == 0.0).all()
    steps = np.zeros((5, robot.dim), np.float32)
    steps[:, robot.speed_dims[0]] = 0.1
    made = spaces.to_command(ActionChunk(steps, space="joint", mode="delta"), seen)
    assert np.allclose(made.rows[:, robot.speed_dims[0]], 0.1)
    assert (made.rows[:, robot.speed_dims[1]] == 0.0).all()
