from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from robots import RobotError, load_robot

Edit = Callable[..., Path]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("control_rate", "controlrate", "top level: unknown key controlrate; allowed: title, urdf,"),
        ("index = 6", "index = 6\nlenght = 3", "groups.0.gripper: unknown key lenght; allowed: index, unit,"),
        ("control_rate = 30.0", "control_rate = '30'", "control_rate = '30': Input should be a valid number"),
        ("control_rate = 30.0", "control_rate = -1.0", "control_rate = -1.0: Input should be greater than 0"),
        ("control_rate = 30.0", "control_rate = nan", "control_rate = nan: Input should be"),
        ("index = 6", "index = true", "groups.0.gripper.index = True: Input should be a valid integer"),
        ("binary = false", "binary = 0", "groups.0.gripper.binary = 0: Input should be a valid boolean"),
        (
            'urdf = "agilex_piper.urdf"',
            'urdf = "../other.urdf"',
            "urdf = '../other.urdf': String should match",
        ),
        ("limits_source", "# limits_source", "limits_source: required and absent"),
        ('front = "cam_high"', 'front = "cam/high"', "cameras.front = 'cam/high': String should match"),
        ("xyz = [-0.25, 0.0, 0.0]", "xyz = [-0.25, 0.0]", "groups.0.mount.xyz = [-0.25, 0.0]"),
        (
            'title = "Two AgileX Piper arms with parallel grippers"',
            'title = ""',
            "title = '': String should have at",
        ),
        ('limits_source = "', "limits_source = 3 # ", "limits_source = 3: Input should be a valid string"),
        (
            'urdf = "agilex_piper.urdf"',
            'urdf = "agilex_piper.xacro"',
            "urdf = 'agilex_piper.xacro': String should",
        ),
        (
            "[cameras]",
            'mount_frame = "the floor"\n[cameras]',
            "mount_frame = 'the floor': String should match",
        ),
        ("[cameras]", "[stand]\nxyz = [0.0, 0.0, 0.0]\n[cameras]", "stand.wxyz: required and absent"),
        ("version = 1", "version = 3", "ros.version = 3: Input should be 1 or 2"),
        ('front = "/camera_f/color/image_raw"', 'front = ""', "ros.cameras.front = ''"),
        (
            'state = "/puppet/joint_left"',
            'state = "/a b"',
            "ros.groups.left_arm.state = '/a b': String should match",
        ),
        (
            'state = "/puppet/joint_left"',
            'topic = "/a"',
            "ros.groups.left_arm: unknown key topic; allowed: state, command, eef,",
        ),
        ('name = "left_arm"', 'name = "left arm"', "groups.0.name = 'left arm': String should match"),
        ('name = "left_arm"', "", "groups.0.name: required and absent"),
        (
            'name = "left_arm"',
            'name = "left_arm"\nkind = "leg"',
            "groups.0.kind = 'leg': Input should be 'arm', 'hand'",
        ),
        (
            'name = "left_arm"',
            'name = "left_arm"\noptional = "no"',
            "groups.0.optional = 'no': Input should be a valid",
        ),
        ('joints = ["joint0",', "joints = [0,", "groups.0.joints.0 = 0: Input should be a valid string"),
        ('joints = ["joint0",', 'joints = ["",', "groups.0.joints.0 = '': String should have at least 1"),
        (
            'urdf_joints = ["joint1",',
            "urdf_joints = [1,",
            "groups.0.urdf_joints.0 = 1: Input should be a valid string",
        ),
        ('frame = "base_link"', "frame = 0", "groups.0.frame = 0: Input should be a valid string"),
        (
            'frame = "base_link"',
            'pinned = "torso"',
            "groups.0.pinned = 'torso': Input should be a valid dictionary",
        ),
        ('unit = "m"', 'unit = ""', "groups.0.gripper.unit = '': String should have at least 1 character"),
        ("lower = 0.0", "lower = 'zero'", "groups.0.gripper.lower = 'zero': Input should be a valid number"),
        (
            "velocity = 1.0",
            "velocity = 0.0",
            "groups.0.gripper.velocity = 0.0: Input should be greater than 0",
        ),
        ("velocity = 1.0", "", "groups.0.gripper.velocity: required and absent"),
        (
            "binary = false",
            "threshold = 'half'",
            "groups.0.gripper.threshold = 'half': Input should be a valid number",
        ),
        (
            "joint7 = [0.0, 0.05]",
            "joint7 = [0.05]",
            "groups.0.gripper.fingers.joint7 = [0.05]: List should have at",
        ),
        ("binary = false", "apart = 0.1", "groups.0.gripper.apart = 0.1: Input should be a valid list"),
        (
            "binary = false",
            "tip = { xyz = [0.0, 0.0, 0.1] }",
            "groups.0.gripper.tip.wxyz: required and absent",
        ),
        (
            "[groups.mount]",
            '[[groups.overrides]]\njoint = "joint1"\nupper = 1.0\n[groups.mount]',
            "groups.0.overrides.0.reason: required and absent",
        ),
        (
            "[collision]",
            "[collision]\nmargin = 0.01",
            "collision: unknown key margin; allowed: capsules, without, ignore",
        ),
        (
            '["link2", "link5"]',
            '["link2"]',
            "collision.ignore.1 = ['link2']: List should have at least 2 items",
        ),
        (
            "[collision]",
            "[collision]\ncapsules = { link2 = { start = [0.0, 0.0, 0.0], end = [0.0, 0.0, 0.1], radius = -1.0 } }",
            "collision.capsules.link2.0.radius = -1.0: Input should be greater than 0",
        ),
        (
            "left_arm = [0.0, 0.0",
            "left_arm = [inf, 0.0",
            "poses.home.left_arm.0 = inf: Input should be a finite",
        ),
        ("[poses.home]", "[poses.'at home']", "poses.at home"),
    ],
)
def test_a_wrong_key_or_value_is_named_with_what_is_allowed(
    edited: Edit, old: str, new: str, said: str
) -> None:
    folder = edited((old, new))
    with pytest.raises(RobotError) as error:
        load_robot(folder)
    assert said in str(error.value)
    assert str(folder / "robot.toml") in str(error.value)


def test_every_wrong_key_is_named_at_once(edited: Edit) -> None:
    folder = edited(("control_rate = 30.0", "control_rate = 0.0"), ("index = 6", "index = -1"))
    with pytest.raises(RobotError) as error:
        load_robot(folder)
    assert "control_rate = 0.0" in str(error.value)
    assert "groups.0.gripper.index = -1" in str(error.value)


def test_a_file_that_is_no_toml_is_refused(edited: Edit) -> None:
    folder = edited(("[cameras]", "[cameras"))
    with pytest.raises(RobotError, match=r"robot\.toml: cannot be read as TOML"):
        load_robot(folder)
