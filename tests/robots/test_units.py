"""Units of a robot's numbers."""

import pytest

import robots
from robots.units import units_of


@pytest.mark.parametrize("name", robots.robot_names())
def test_grippers_have_their_own_unit_and_joints_that_turn_rad(name):
    robot = robots.load_robot(name)
    units = units_of(robot)
    assert len(units) == robot.dim
    for group in robot.groups:
        if group.gripper is not None:
            assert units[group.gripper_dim] == group.gripper.unit
        for arm in robot.arms:
            assert {units[dim] for dim in arm.joint_dims} == {"rad"}


def test_what_slides_is_in_metres_and_what_moves_no_link_has_no_unit(tmp_path):
    folder = tmp_path / "cart"
    folder.mkdir()
    (folder / "cart.urdf").write_text(
        """<robot name="cart"><link name="world"/><link name="lift"/><link name="head"/>
<joint name="up" type="prismatic"><parent link="world"/><child link="lift"/><axis xyz="0 0 1"/>
<limit lower="0" upper="0.5" velocity="0.1" effort="1"/></joint>
<joint name="pan" type="revolute"><parent link="lift"/><child link="head"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>"""
    )
    (folder / "robot.toml").write_text(
        """title = "Cart"
urdf = "cart.urdf"
limits_source = "made up"
control_rate = 10.0
cameras = {}
[[groups]]
name = "body"
joints = ["up", "pan"]
urdf_joints = ["up", "pan"]
[[groups]]
name = "base"
joints = ["forward"]
urdf_joints = [""]
overrides = [{ joint = "forward", lower = -1.0, upper = 1.0, velocity = 1.0, reason = "made up" }]
[poses.home]
body = [0.0, 0.0]
base = [0.0]
"""
    )
    assert units_of(robots.load_robot(folder)) == ("m", "rad", "")
