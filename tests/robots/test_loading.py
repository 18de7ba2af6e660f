from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import robots
from robots import RobotError, load_robot

Edit = Callable[..., Path]
FIRST = 'eef_link = "gripper_base"\n'
OVERRIDE = '[[groups.overrides]]\njoint = "{joint}"\n{key} = {value}\nreason = "the mount is in the way"\n'


def test_the_piper_comes_with_the_program() -> None:
    assert "agilex_piper" in robots.robot_names()
    robot = load_robot("agilex_piper")
    assert robot.name == "agilex_piper"
    assert robot.dim == 14
    assert robot.control_rate == 30.0


def test_a_folder_is_as_good_as_a_name(edited: Edit) -> None:
    folder = edited()
    assert load_robot(folder).name == "copy"
    assert load_robot(str(folder)).joint_names == load_robot("agilex_piper").joint_names


def test_an_unknown_robot_is_answered_with_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(RobotError, match=r"no robot 'pipper'; known: .*agilex_piper"):
        load_robot("pipper")
    with pytest.raises(RobotError, match=r"or a folder with robot\.toml"):
        load_robot(tmp_path)


def test_every_robot_that_comes_with_the_program_loads_and_has_a_readme() -> None:
    for name in robots.robot_names():
        robot = load_robot(name)
        assert (robot.folder / "README.md").is_file()
        assert robot.lower.shape == robot.upper.shape == robot.velocity.shape == (robot.dim,)


def test_limits_come_from_the_urdf_and_grippers_from_the_file() -> None:
    robot = load_robot("agilex_piper")
    lower = [-2.618, 0.0, -2.967, -1.745, -1.22, -2.0944, 0.0]
    upper = [2.618, 3.14, 0.0, 1.745, 1.22, 2.0944, 0.1]
    velocity = [5.0, 5.0, 5.0, 5.0, 5.0, 3.0, 1.0]
    np.testing.assert_array_equal(robot.lower, lower * 2)
    np.testing.assert_array_equal(robot.upper, upper * 2)
    np.testing.assert_array_equal(robot.velocity, velocity * 2)
    assert robot.overrides == ()


def test_an_override_replaces_a_limit_of_one_arm_and_keeps_its_reason(edited: Edit) -> None:
    override = OVERRIDE.format(joint="joint5", key="upper", value=1.5)
    robot = load_robot(edited(("[groups.mount]", override + "\n[groups.mount]")))
    assert robot.upper[5] == 1.5
    assert robot.upper[12] == 2.0944
    assert robot.overrides == ("left_arm.joint5 upper 2.0944 -> 1.5: the mount is in the way",)


def test_nothing_that_was_loaded_can_be_changed_by_accident() -> None:
    robot = load_robot("agilex_piper")
    for array in (robot.lower, robot.upper, robot.velocity, robot.poses["home"], robot.groups[0].mount):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0


def test_a_robot_travels_between_processes() -> None:
    robot = load_robot("agilex_piper")
    copy = pickle.loads(pickle.dumps(robot))
    assert copy.joint_names == robot.joint_names
    q = np.full(6, 0.3)
    np.testing.assert_array_equal(copy.arms[1].chain.pose(q), robot.arms[1].chain.pose(q))


@pytest.mark.some(29)
@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('name = "right_arm"', 'name = "left_arm"', "groups: left_arm more than once"),
        ('right_wrist = "cam_right_wrist"', 'right_wrist = "cam_high"', "cameras: cam_high more than once"),
        ('"joint5", "joint6"]\nurdf', '"joint5", "joint5"]\nurdf', "left_arm.joints: joint5 more than once"),
        ('"joint5", "joint6"]\nframe', '"joint5"]\nframe', "urdf_joints names 5 joints; allowed: 6"),
        ('"joint5", "joint6"]\nframe', '"joint5", "joint9"]\nframe', "no joint 'joint9'; it has joint1"),
        ('"joint5", "joint6"]\nframe', '"joint5", "joint8"]\nframe', "joint8 is fixed or a mimic"),
        (
            '"joint5", "joint6"]\nframe',
            '"joint5", "joint7"]\nframe',
            "left_arm.gripper.fingers: joint7 is also among urdf_joints",
        ),
        (FIRST, 'eef_link = "link7"\n', "left_arm: "),
        (FIRST, 'eef_link = "link7"\n', "'joint7' lies between base_link and link7, not driven"),
        ('"joint5", "joint6"]\nframe', '"joint5", "joint5"]\nframe', "urdf_joints: joint5 more than once"),
        (
            '"joint5", "joint6"]\nframe',
            '"joint5", ""]\nframe',
            'urdf_joints has ""; allowed for an arm: joints',
        ),
        (
            'urdf = "agilex_piper.urdf"',
            'urdf = "piper.urdf"',
            "urdf = 'piper.urdf' is no file; URDFs in the folder: agilex_piper.urdf",
        ),
        (FIRST, FIRST + "pinned = { joint9 = 0.0 }\n", "left_arm.pinned: "),
        (FIRST, FIRST + "pinned = { joint9 = 0.0 }\n", "no joint 'joint9'; it has joint1"),
        (
            FIRST,
            FIRST + "pinned = { joint1 = 0.0 }\n",
            "joint1 is fixed or among urdf_joints; allowed: other",
        ),
        ('frame = "base_link"', 'frame = "floor"', "left_arm: from frame to eef_link: "),
        (
            'frame = "base_link"\n' + FIRST,
            'kind = "arm"\n',
            'left_arm.kind = "arm"; allowed without eef_link',
        ),
        (
            'frame = "base_link"\n' + FIRST,
            "pinned = { joint1 = 0.0 }\n",
            "left_arm.pinned: joint1; allowed only with eef_link and frame",
        ),
        ("fingers = { joint7", "fingers = { joint9", "left_arm.gripper.fingers: "),
        ("fingers = { joint7", "fingers = { joint8", "joint8 is fixed or a mimic"),
        (
            "binary = false",
            "apart = [0.1, 0.05]",
            "gripper.apart = [0.1, 0.05]; allowed: 0 <= at close < at open",
        ),
        ("close = 0.0", "close = -0.1", "left_arm.gripper.close = -0.1; allowed: 0.0 to 0.1"),
        (
            "[cameras]",
            "[stand]\nxyz = [0.0, 0.0, 0.0]\nwxyz = [1.0, 1.0, 0.0, 0.0]\n[cameras]",
            "stand.wxyz has",
        ),
        (
            "[ros.groups.left_arm]",
            "[ros.groups.head]",
            "ros.groups names head; allowed: left_arm, right_arm",
        ),
        (
            'front = "/camera_f/color/image_raw"',
            'head = "/camera_f/color/image_raw"',
            "ros.cameras names head; allowed: front, left_wrist, right_wrist",
        ),
        (
            "[collision]",
            '[lerobot.joints.head]\npan = { feature = "pan.pos" }\n[collision]',
            "lerobot.joints names head; allowed: left_arm, right_arm",
        ),
        (
            "[collision]",
            '[lerobot.joints.left_arm]\npan = { feature = "pan.pos" }\n[collision]',
            "lerobot.joints.left_arm names pan; allowed: joint0, joint1,",
        ),
        (
            "[collision]",
            '[collision]\nwithout = ["cover"]',
            "collision.without names cover; allowed: base_link,",
        ),
        (
            "[collision]",
            "[collision]\ncapsules = { cover = { start = [0.0, 0.0, 0.0], end = [0.0, 0.0, 0.1], radius = 0.1 } }",
            "collision.capsules names cover; allowed: base_link,",
        ),
        (
            '["link2", "link5"]',
            '["link2", "left_arm/cover"]',
            "collision.ignore names left_arm/cover; allowed: table",
        ),
        (FIRST, 'eef_link = "hand"\n', "no link 'hand'"),
        (FIRST, "", "eef_link and frame make an arm together"),
        ("index = 6", "index = 7", "left_arm.gripper.index = 7; allowed: 0 to 6"),
        ("open = 0.1", "open = 0.2", "left_arm.gripper.open = 0.2; allowed: 0.0 to 0.1"),
        ("open = 0.1", "open = 0.0", "open = 0.0 is also close"),
        ("binary = false", "binary = true", "threshold = None; needed if and only if binary = true"),
        ("binary = false", "threshold = 0.05", "threshold = 0.05; needed if and only if binary = true"),
        ("binary = false", "binary = true\nthreshold = 0.1", "threshold = 0.1; allowed: between 0.0 and 0.1"),
        ("binary = false", "hysteresis = 0.1", "hysteresis = 0.1; allowed only with binary = true"),
        (
            "binary = false",
            "binary = true\nthreshold = 0.09\nhysteresis = 0.3",
            "hysteresis = 0.3; allowed with the threshold 0.09: 0 to 0.2 of the travel, or it could not switch back",
        ),
        ("wxyz = [0.7071067811865476", "wxyz = [0.5", "mount.wxyz has length"),
        ("[poses.home]", "[poses.start]", "poses: start, ready given; needed: home"),
        ("left_arm = [0.0,", "arm = [0.0,", "poses.home gives arm, right_arm; needed: left_arm, right_arm"),
        ("left_arm = [0.0,", "left_arm = [", "poses.home.left_arm has 6 numbers; needed: 7"),
        ("left_arm = [0.0, 0.0", "left_arm = [0.0, -0.1", "joint1 = -0.1; allowed: 0.0 to 3.14"),
    ],
)
def test_what_does_not_fit_together_is_named(edited: Edit, old: str, new: str, said: str) -> None:
    folder = edited((old, new))
    with pytest.raises(RobotError) as error:
        load_robot(folder)
    assert said in str(error.value)
    assert str(folder) in str(error.value)


@pytest.mark.parametrize(
    ("joint", "key", "value", "said"),
    [
        ("joint6", "upper", 1.0, "overrides names joint 'joint6'; allowed: joint0,"),
        ("joint1", "upper", -1.0, "joint 'joint1' has range 0.0 to -1.0"),
        ("joint1", "velocity", 0.0, "Input should be greater than 0"),
        ("", "upper", 1.0, "overrides.0.joint = '': String should have at least 1 character"),
    ],
)
def test_an_override_that_makes_no_sense_is_refused(
    edited: Edit, joint: str, key: str, value: float, said: str
) -> None:
    override = OVERRIDE.format(joint=joint, key=key, value=value)
    with pytest.raises(RobotError) as error:
        load_robot(edited(("[groups.mount]", override + "\n[groups.mount]")))
    assert said in str(error.value)


def test_a_joint_without_a_limit_needs_an_override(edited: Edit) -> None:
    folder = edited()
    file = folder / "agilex_piper.urdf"
    limit = '<limit lower="-2.0944" upper="2.0944" velocity="3.0" effort="100.0"/>'
    text = file.read_text()
    assert limit in text
    file.write_text(text.replace(limit, ""))
    with pytest.raises(RobotError, match="'joint5': the URDF gives no lower for joint6; needed: an override"):
        load_robot(folder)


def test_fingertips_lie_between_the_fingers_of_the_urdf() -> None:
    for arm in load_robot("agilex_piper").arms:
        assert arm.tip is not None
        np.testing.assert_allclose(arm.tip[:3, 3], [0.0, 0.0, 0.1358], atol=1e-12)
        np.testing.assert_allclose(arm.tip[:3, :3], np.eye(3), atol=1e-5)
        assert not arm.tip.flags.writeable


def test_the_way_in_which_the_fingers_slide_is_the_tips_y(edited: Edit) -> None:
    folder = edited()
    file = folder / "agilex_piper.urdf"
    text = file.read_text()
    finger = '<origin xyz="0.0 0.0 0.1358" rpy="1.5708 0.0 0.0"/>'
    assert finger in text
    file.write_text(text.replace(finger, '<origin xyz="0.02 0.0 0.1" rpy="1.5707963267949 0.0 0.7"/>'))
    tip = load_robot(folder).arms[0].tip
    assert tip is not None
    np.testing.assert_allclose(tip[:3, 3], [0.01, 0.0, 0.1179], atol=1e-9)
    np.testing.assert_allclose(tip[:3, 1], [-np.sin(0.7), np.cos(0.7), 0.0], atol=1e-9)
    np.testing.assert_allclose(tip[:3, 2], [0.0, 0.0, 1.0], atol=1e-9)
    assert np.linalg.det(tip[:3, :3]) == pytest.approx(1.0)


def test_without_sliding_fingers_the_end_effector_is_the_fingertip(edited: Edit) -> None:
    folder = edited()
    file = folder / "agilex_piper.urdf"
    file.write_text(file.read_text().replace('type="prismatic"', 'type="revolute"'))
    tip = load_robot(folder).arms[0].tip
    assert tip is not None
    np.testing.assert_array_equal(tip, np.eye(4))


def test_fingertips_that_are_declared_count(edited: Edit) -> None:
    declared = "[groups.gripper.tip]\nxyz = [0.0, 0.01, 0.2]\nwxyz = [0.0, 0.0, 0.0, 1.0]\n\n[groups.mount]"
    left, right = load_robot(edited(("[groups.mount]", declared))).arms
    assert left.tip is not None
    assert right.tip is not None
    np.testing.assert_allclose(left.tip[:3, 3], [0.0, 0.01, 0.2])
    np.testing.assert_allclose(left.tip[:3, :3], np.diag([-1.0, -1.0, 1.0]), atol=1e-12)
    np.testing.assert_allclose(right.tip[:3, 3], [0.0, 0.0, 0.1358])


def test_a_declared_fingertip_needs_a_unit_quaternion(edited: Edit) -> None:
    declared = "[groups.gripper.tip]\nxyz = [0.0, 0.0, 0.2]\nwxyz = [1.0, 1.0, 0.0, 0.0]\n\n[groups.mount]"
    with pytest.raises(RobotError, match=r"left_arm\.gripper\.tip\.wxyz has length 1\.41.*allowed: 1"):
        load_robot(edited(("[groups.mount]", declared)))


def test_an_override_that_changes_nothing_is_refused(edited: Edit) -> None:
    override = '[[groups.overrides]]\njoint = "joint1"\nreason = "none"\n\n[groups.mount]'
    with pytest.raises(
        RobotError, match=r"left_arm\.overrides: joint1 changes nothing; needed: lower, upper or"
    ):
        load_robot(edited(("[groups.mount]", override)))


def test_a_robot_whose_groups_are_all_optional_is_refused(edited: Edit) -> None:
    folder = edited(('name = "left_arm"', 'name = "left_arm"\noptional = true'))
    assert [group.name for group in load_robot(folder).groups] == ["right_arm"]
    file = folder / "robot.toml"
    file.write_text(file.read_text().replace('name = "right_arm"', 'name = "right_arm"\noptional = true'))
    with pytest.raises(RobotError, match="groups: all are optional; needed: one that is always part"):
        load_robot(folder)
    assert [group.name for group in load_robot(folder, ["left_arm"]).groups] == ["left_arm"]


def test_groups_of_one_copy_of_the_urdf_stand_in_one_place(edited: Edit) -> None:
    """The second group moves nothing of the URDF that the first does: both are one body."""
    joints = 'urdf_joints = ["joint1", "joint2", "joint3", "joint4", "joint5", "joint6"]\n'
    arm = 'joints = ["joint0", "joint1", "joint2", "joint3", "joint4", "joint5", "joint6"]\n' + joints
    head = 'joints = ["yaw", "joint6"]\nurdf_joints = [""]\noverrides = [{ joint = "yaw", lower = -1.0, upper = 1.0, '
    head += 'velocity = 1.0, reason = "measured" }]\n'
    folder = edited()
    file = folder / "robot.toml"
    before, right = file.read_text().split('name = "right_arm"\n')
    right = right.replace(arm + 'frame = "base_link"\n' + FIRST, head).replace("index = 6", "index = 1")
    right = right.replace("fingers = { joint7 = [0.0, 0.05] }", "")
    for zeros in (
        "right_arm = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]",
        "right_arm = [-0.35, 1.15, -0.85, 0.0, 1.1, 0.0, 0.1]",
    ):
        assert zeros in right
        right = right.replace(zeros, "right_arm = [0.0, 0.0]")
    file.write_text(before + 'name = "right_arm"\n' + right)
    with pytest.raises(RobotError, match=r"groups\.right_arm\.mount differs from that of left_arm"):
        load_robot(folder)


def test_what_is_chosen_has_to_be_there(edited: Edit) -> None:
    with pytest.raises(RobotError, match=r"groups \['head'\] were chosen; allowed: left_arm, right_arm"):
        load_robot(edited(), ["head"])
    with pytest.raises(RobotError, match=r"groups \[\] were chosen"):
        load_robot("agilex_piper", [])
    with pytest.raises(
        RobotError, match=r"grippers of head were chosen; groups with a gripper: left_arm, right"
    ):
        load_robot("agilex_piper", grippers={"head": robots.GripperChoice(binary=True)})


def test_robots_of_ones_own_lie_in_the_folders_of_an_environment_variable(
    edited: Edit, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = edited()
    monkeypatch.setenv("EVA_ROBOTS", str(folder.parent))
    assert "copy" in robots.robot_names()
    assert load_robot("copy").folder == folder
    folder.rename(folder.parent / "agilex_piper")
    assert load_robot("agilex_piper").folder != folder.parent / "agilex_piper"
