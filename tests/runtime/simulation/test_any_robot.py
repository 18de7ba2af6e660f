"""The pick-and-place script succeeds with every robot, in joints and through poses and kinematics; in lockstep."""

from __future__ import annotations

import pytest

from runtime.ipc.session_state import SessionState
from tests.runtime.simulation.tabletop_station import pick_and_place

EVERY_MILESTONE = {"grasped": True, "lifted": True, "over_plate": True, "placed": True}
IN_JOINTS = ["tabletop", "tabletop_arx_r5", "tabletop_dual_franka", "tabletop_r1_lite", "tabletop_agibot_g2"]
WRITTEN = [  # in other words than our own
    ("tabletop_dual_franka", ['policy.action_pose={orientation="6d", frame="workcell"}']),
    ("tabletop_ur5e", ['policy.action_pose={orientation="euler", euler_order="ZYX", degrees=true}']),
    ("tabletop_agibot_g2", ['policy.action_pose={orientation="xyzw", groups=["head", "body"]}']),
    ("tabletop_arx_r5", ['policy.action_pose={orientation="rotation_vector"}']),
]


def assert_placed(name, seed, data, assignments=()):
    trial = pick_and_place(name, seed, data, assignments)
    assert trial.success, trial.events
    assert trial.milestones == EVERY_MILESTONE
    assert trial.state is SessionState.RUNNING


def test_one_arm_puts_the_block_on_the_plate(tmp_path):
    assert_placed("tabletop_ur5e", 0, tmp_path)


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", IN_JOINTS)
def test_every_robot_puts_the_block_on_the_plate(name, tmp_path):
    assert_placed(name, 1, tmp_path)


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", ["tabletop_agilex_piper_eef", "tabletop_ur5e_eef"])
def test_so_does_a_policy_in_poses_whose_rows_kinematics_make_joints_of(name, tmp_path):
    assert_placed(name, 2, tmp_path)


@pytest.mark.exhaustive
@pytest.mark.parametrize(("name", "assignments"), WRITTEN, ids=[name for name, _ in WRITTEN])
def test_it_does_not_matter_how_poses_are_written(name, assignments, tmp_path):
    assert_placed(name, 3, tmp_path, ['policy.action_space="eef"', *assignments])
