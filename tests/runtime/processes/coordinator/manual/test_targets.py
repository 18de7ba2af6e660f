"""Where a person wants the robot: checked before anything moves."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import robots
from runtime.core.errors import RuntimeFault
from runtime.ipc.command_arguments import AimRequest, Jog, MoveRequest
from runtime.kinematics import compiled
from runtime.motion.timeline import DimensionKinds
from runtime.processes.coordinator.manual.targets import Targets
from runtime.safety.filter import Limits, SafetySettings, WorkspaceBox
from runtime.spaces.conversion import ActionSpaces


@cache
def parts() -> tuple[Any, Any, Any]:
    robot = robots.load_robot("agilex_piper")
    kinematics = compiled.build(compiled.Config(), robot)
    return robot, kinematics, ActionSpaces(robot, kinematics, 30.0)


def targets(workspace: dict[str, WorkspaceBox] | None = None) -> Targets:
    robot, kinematics, spaces = parts()
    grippers = np.isin(np.arange(robot.dim), robot.gripper_dims)
    limits = Limits(
        robot.joint_names, robot.lower, robot.upper, robot.velocity, grippers, np.zeros(robot.dim, bool)
    )
    chosen = SimpleNamespace(safety=SafetySettings(workspace=workspace or {}))
    spec: Any = SimpleNamespace(robot=robot, limits=limits, deployment=chosen, dims=DimensionKinds())
    return Targets(spec, spaces, kinematics)


def ready() -> np.ndarray:
    return parts()[0].poses["ready"].copy()


def test_a_named_pose_is_where_it_is() -> None:
    aim = targets().aim(AimRequest(pose="ready"), np.zeros(14))
    assert np.array_equal(aim.joints, ready())
    assert aim.clipped == ()
    assert aim.poses.shape == (16,)


def test_what_is_beyond_a_limit_is_clipped_and_named_by_aim_and_refused_by_move() -> None:
    robot = parts()[0]
    joints = ready()
    joints[1] = robot.upper[1] + 0.5
    aim = targets().aim(AimRequest(joints=joints.tolist()), ready())
    assert aim.clipped == (robot.joint_names[1],)
    assert aim.joints[1] == robot.upper[1]
    with pytest.raises(RuntimeFault, match=rf"move: {robot.joint_names[1]} = .*; allowed: "):
        targets().motion_goal(MoveRequest(joints=joints.tolist()), ready())


def test_a_joint_that_is_null_stays_where_it_is_commanded_to_be() -> None:
    commanded = ready()
    commanded[6] = 0.03
    joints = [None, 0.1, *[None] * 12]
    wanted = np.array([commanded[0], 0.1, *commanded[2:]])
    assert np.array_equal(targets().motion_goal(MoveRequest(joints=joints), commanded), wanted)
    assert np.array_equal(targets().aim(AimRequest(joints=joints), commanded).joints, wanted)


@pytest.mark.parametrize(
    ("asked", "sentence"),
    [
        (MoveRequest(), "say joints or a pose; poses of agilex_piper: home, ready"),
        (MoveRequest(pose="dance"), "pose = 'dance'; agilex_piper has home, ready"),
        (MoveRequest(joints=[0.0] * 3), "3 joints; agilex_piper has 14"),
        (MoveRequest(joints=[0.0] * 14, pose="home"), "allowed: one of the two"),
    ],
)
def test_a_wish_that_means_nothing_is_refused_with_what_is_allowed(asked: MoveRequest, sentence: str) -> None:
    with pytest.raises(RuntimeFault, match=sentence):
        targets().motion_goal(asked, ready())


@pytest.mark.parametrize("frame", ["base", "tool"])
@given(shift=st.tuples(*[st.floats(-0.03, 0.03)] * 3), turn=st.tuples(*[st.floats(-0.2, 0.2)] * 3))
def test_a_jog_moves_one_end_effector_by_what_was_asked_and_no_other_joint(
    frame: Any, shift: tuple[float, ...], turn: tuple[float, ...]
) -> None:
    robot, kinematics, _ = parts()
    jog = Jog(arm="left_arm", frame=frame, translation=list(shift), rotation=list(turn))
    aim = targets().aim(AimRequest(jog=jog), ready())
    assert np.array_equal(aim.joints[7:], ready()[7:])
    assert aim.joints[6] == ready()[6]
    assert (aim.joints >= robot.lower).all()
    assert (aim.joints <= robot.upper).all()
    if aim.reached:
        before, after = kinematics.forward(ready())[0], kinematics.forward(aim.joints)[0]
        assert np.isclose(np.linalg.norm(after[:3] - before[:3]), np.linalg.norm(shift), atol=1.5e-3)
        if frame == "base":
            assert np.allclose(after[:3] - before[:3], shift, atol=1.5e-3)


def test_a_jog_out_of_reach_says_so_and_by_how_much() -> None:
    aim = targets().aim(AimRequest(jog=Jog(arm="left_arm", translation=[2.0, 0.0, 0.0])), ready())
    assert not aim.reached
    assert aim.position_error > 0.5


def test_an_arm_that_there_is_not_is_refused() -> None:
    with pytest.raises(RuntimeFault, match=r"jog.arm = 'third'; agilex_piper has left_arm, right_arm"):
        targets().aim(AimRequest(jog=Jog(arm="third")), ready())


def test_a_way_that_leaves_the_workspace_box_is_refused_and_one_that_comes_back_into_it_is_not() -> None:
    _, kinematics, _ = parts()
    here = kinematics.forward(ready())[0, :3]
    box = WorkspaceBox(lower=(here - 0.05).tolist(), upper=(here + 0.05).tolist())
    boxed = targets({"left_arm": box})
    away = ready()
    away[0] += 1.2
    with pytest.raises(RuntimeFault, match="left_arm would leave the workspace box on its way"):
        boxed.motion_goal(MoveRequest(joints=away.tolist()), ready())
    assert np.array_equal(boxed.motion_goal(MoveRequest(pose="ready"), away), ready())


def test_half_the_speed_takes_longer_and_no_way_takes_no_time() -> None:
    home = parts()[0].poses["home"]
    whole, half = (targets().duration(ready(), home, speed) for speed in (1.0, 0.5))
    assert half > whole > 0
    assert targets().duration(ready(), ready()) == 0.0
