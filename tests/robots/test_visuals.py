from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from robots import Group, RobotError, load_robot, scene_of
from robots.rotations import matrix_of_quaternion

Edit = Callable[..., Path]

PIPER = load_robot("agilex_piper")
SCENE = scene_of(PIPER)
MOVED = np.array([0.3, 0.9, -1.1, 0.4, -0.5, 0.6, 0.06, -0.2, 1.2, -0.8, -0.3, 0.7, 1.1, 0.1])


def test_each_arm_has_a_copy_of_every_link() -> None:
    links = [f"link{number}" for number in range(1, 7)]
    links = ["base_link", *links, "gripper_base", "link7", "link8"]
    assert SCENE.parts == tuple(f"{arm}/{link}" for arm in ("left_arm", "right_arm") for link in links)
    assert len(SCENE.visuals) % 2 == 0
    assert {visual.part for visual in SCENE.visuals} == set(range(len(SCENE.parts)))


@pytest.mark.parametrize("arm", PIPER.arms, ids=lambda arm: arm.name)
def test_the_end_effector_stands_where_kinematics_puts_it_behind_the_mount(arm: Group) -> None:
    mount = np.eye(4)
    mount[:3, :3], mount[:3, 3] = matrix_of_quaternion(arm.mount[3:]), arm.mount[:3]
    wanted = mount @ arm.chain.forward(MOVED[arm.joint_dims])
    found = SCENE.poses(MOVED)[SCENE.part(f"{arm.name}/{arm.eef_link}")]
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("opening", "apart"), [(0.0, 0.0), (0.04, 0.04), (0.1, 0.1), (-0.003, 0.0), (0.2, 0.1)]
)
def test_the_jaws_are_as_far_apart_as_the_gripper_says_within_its_range(opening: float, apart: float) -> None:
    q = MOVED.copy()
    q[6] = opening
    first, second = (SCENE.poses(q)[part] for part in SCENE.jaws["left_arm"])
    assert np.linalg.norm(first[:3, 3] - second[:3, 3]) == pytest.approx(apart, abs=1e-6)
    right = [SCENE.poses(q)[part] for part in SCENE.jaws["right_arm"]]
    assert np.linalg.norm(right[0][:3, 3] - right[1][:3, 3]) == pytest.approx(MOVED[13], abs=1e-6)


def test_many_vectors_at_once_give_what_one_at_a_time_gives() -> None:
    many = np.random.default_rng(1).uniform(PIPER.lower, PIPER.upper, (3, 2, PIPER.dim))
    poses = SCENE.poses(many)
    assert poses.shape == (3, 2, len(SCENE.parts), 4, 4)
    for index in np.ndindex(3, 2):
        np.testing.assert_allclose(poses[index], SCENE.poses(many[index]), rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(poses[..., :3, :3]), 1.0, atol=1e-9)


def test_wrong_shapes_and_names_are_refused_with_what_is_allowed() -> None:
    with pytest.raises(RobotError, match=r"joints of shape \(7,\) were given; allowed: \[\.\.\., 14\]"):
        SCENE.poses(np.zeros(7))
    with pytest.raises(RobotError, match="no part 'link2'; it has left_arm/base_link"):
        SCENE.part("link2")


def test_a_finger_that_cannot_move_by_itself_is_refused(edited: Edit) -> None:
    with pytest.raises(RobotError, match="fingers: joint8 is fixed or a mimic; allowed: joints that move"):
        load_robot(edited(("{ joint7 = [0.0, 0.05] }", "{ joint8 = [0.0, 0.05] }")))


WHOLE = """<robot name="whole"><link name="base"/><link name="chest"/><link name="l"/><link name="r"/>
<link name="lid"><visual><geometry><box size="1 1 1"/></geometry></visual></link>
<joint name="waist" type="prismatic"><parent link="base"/><child link="chest"/><axis xyz="0 0 1"/></joint>
<joint name="left" type="prismatic"><parent link="chest"/><child link="l"/><axis xyz="1 0 0"/>
<limit lower="-1" upper="1" velocity="1"/></joint>
<joint name="right" type="prismatic"><parent link="chest"/><child link="r"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" velocity="1"/></joint>
<joint name="hinge" type="prismatic"><parent link="l"/><child link="lid"/><axis xyz="0 0 1"/>
<mimic joint="left" multiplier="2" offset="0.5"/></joint></robot>"""
ARM = """[[groups]]
name = "{name}_arm"
joints = ["{name}", "grip"]
urdf_joints = ["{name}"]
frame = "base"
eef_link = "{link}"
pinned = {{ waist = 0.25 }}
[groups.gripper]
index = 1
unit = "m"
lower = 0.0
upper = 1.0
open = 1.0
close = 0.0
velocity = 1.0
[groups.mount]
xyz = [0.0, 0.0, 1.0]
wxyz = [1.0, 0.0, 0.0, 0.0]
"""


def test_a_urdf_of_the_whole_body_is_shown_once_with_pinned_joints_and_mimics(tmp_path: Path) -> None:
    (tmp_path / "whole.urdf").write_text(WHOLE)
    (tmp_path / "robot.toml").write_text(
        'title = "whole"\nurdf = "whole.urdf"\nlimits_source = "none"\ncontrol_rate = 30.0\n[cameras]\n'
        + ARM.format(name="left", link="l")
        + ARM.format(name="right", link="r")
        + "[poses.home]\nleft_arm = [0.0, 0.0]\nright_arm = [0.0, 0.0]\n"
    )
    scene = scene_of(load_robot(tmp_path))
    assert sorted(scene.parts) == [
        "left_arm/base",
        "left_arm/chest",
        "left_arm/l",
        "left_arm/lid",
        "right_arm/r",
    ]
    poses = scene.poses(np.array([0.1, 0.0, 0.2, 0.0]))
    np.testing.assert_allclose(poses[scene.part("left_arm/base"), :3, 3], [0, 0, 1])
    np.testing.assert_allclose(poses[scene.part("right_arm/r"), :3, 3], [0, 0.2, 1.25])
    np.testing.assert_allclose(poses[scene.part("left_arm/lid"), :3, 3], [0.1, 0, 1.95])
    assert [visual.part for visual in scene.visuals] == [scene.part("left_arm/lid")]
