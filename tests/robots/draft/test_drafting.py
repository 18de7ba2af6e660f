from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from robots import Body, Robot, RobotError, description, load_robot
from robots.__main__ import main
from robots.clearance import collision_problems
from robots.draft import DraftResult, draft_robot
from tests.robots.draft.urdfs import arm, base, dual, jaws, joint, link, single, write


def drafted(tmp_path: Path, body: str, copies: int = 1) -> tuple[DraftResult, Robot]:
    """The draft, and the robot with all of its groups."""
    made = draft_robot("mine", write(tmp_path / "from", body), tmp_path / "into", copies)
    assert made.inspection.errors == ()
    usual = load_robot(made.folder)
    assert collision_problems(usual) == []
    names = [group.name for group in description.read(made.folder / "robot.toml").groups]
    return made, load_robot(made.folder, names)


def test_one_arm_with_a_gripper_is_seven_numbers(tmp_path: Path) -> None:
    made, robot = drafted(tmp_path, single())
    assert made.folder == tmp_path / "into" / "mine"
    assert {path.name for path in made.folder.iterdir()} == {"robot.toml", "mine.urdf", "README.md"}
    assert robot.joint_names == (*(f"arm.joint{number}" for number in range(1, 7)), "arm.finger_joint1")
    (arm,) = robot.arms
    assert (arm.frame, arm.eef_link) == ("base_link", "link6")
    assert arm.gripper is not None
    assert (arm.gripper.open, arm.gripper.close, arm.gripper.apart) == (0.04, 0.0, (0.0, 0.08))
    assert [camera.key for camera in robot.cameras] == ["cam_high", "cam_wrist"]
    assert (robot.poses["home"] >= robot.lower).all()
    assert (robot.poses["home"] <= robot.upper).all()
    assert robot.overrides == ()


def test_ready_is_over_the_table_with_fingers_down_and_inside_the_limits(tmp_path: Path) -> None:
    _, robot = drafted(tmp_path, single())
    ready = robot.poses["ready"]
    (arm,) = robot.arms
    assert arm.tip is not None
    tip = Body(robot).poses(ready)[Body(robot).link_of("arm", "link6")] @ arm.tip
    assert tip[2, 2] < -0.9
    assert 0.1 < tip[2, 3] < 0.4
    assert tip[1, 3] > 0.1
    joints = arm.joint_dims
    assert (ready[joints] - robot.lower[joints] > 0.1).all()
    assert (robot.upper[joints] - ready[joints] > 0.1).all()


def test_the_same_urdf_gives_the_same_draft(tmp_path: Path) -> None:
    first, _ = drafted(tmp_path, single())
    again = draft_robot("mine", tmp_path / "from" / "made_up.urdf", tmp_path / "other")
    assert (first.folder / "robot.toml").read_text() == (again.folder / "robot.toml").read_text()


def test_an_arm_without_a_gripper_is_six_numbers(tmp_path: Path) -> None:
    _, robot = drafted(tmp_path, base() + arm("base_link"))
    assert robot.dim == 6
    assert robot.arms[0].gripper is None
    assert robot.arms[0].eef_link == "link6"


def test_two_arms_on_a_torso_with_head_and_wheels(tmp_path: Path) -> None:
    made, robot = drafted(tmp_path, dual())
    assert [group.name for group in load_robot(made.folder).groups] == ["left_arm", "right_arm"]
    assert [(group.name, group.kind, group.dof) for group in robot.groups] == [
        ("left_arm", "arm", 7),
        ("right_arm", "arm", 7),
        ("torso", "torso", 2),
        ("head", "head", 2),
        ("base", "base", 3),
    ]
    assert [arm.frame for arm in robot.arms] == ["torso2", "torso2"]
    assert "wheel_joint1, wheel_joint2" in next(
        line for line in made.inspection.lines if "no group moves" in line
    )
    ready = robot.split(robot.poses["ready"])
    poses = [arm.pose(robot.poses["ready"]) for arm in robot.arms]
    np.testing.assert_allclose(poses[0][:3] * [1, -1, 1], poses[1][:3], atol=1e-6)  # mirrored
    assert not np.allclose(ready["left_arm"], ready["right_arm"])


def test_a_torso_that_is_off_stays_in_drawings_where_it_is_at_home(tmp_path: Path) -> None:
    made, _ = drafted(tmp_path, dual())
    pinned = next(line for line in made.inspection.lines if "pinned" in line)
    assert "lift = 0.02" in pinned


def test_two_copies_of_one_arm_stand_side_by_side(tmp_path: Path) -> None:
    _, robot = drafted(tmp_path, single(), copies=2)
    assert [group.name for group in robot.groups] == ["left_arm", "right_arm"]
    assert [group.mount[0] for group in robot.groups] == [-0.25, 0.25]
    assert [camera.key for camera in robot.cameras] == ["cam_high", "cam_left_wrist", "cam_right_wrist"]


def test_copies_are_of_one_arm(tmp_path: Path) -> None:
    with pytest.raises(RobotError, match="2 copies of 2 arms; allowed: copies of a URDF with one arm"):
        draft_robot("mine", write(tmp_path, dual()), tmp_path / "into", 2)
    with pytest.raises(RobotError, match="0 copies; allowed: 1 to 8"):
        draft_robot("mine", write(tmp_path, single()), tmp_path / "into", 0)


def test_limits_that_nobody_meant_are_overridden_and_say_so(tmp_path: Path) -> None:
    body = single().replace('<limit lower="-2.5" upper="2.5" velocity="2.0" effort="10"/>', "", 1)
    made, robot = drafted(tmp_path, body)
    assert robot.upper[0] == 3.1416
    assert robot.velocity[0] == 1.0
    assert "gives no range and the URDF gives no velocity: a placeholder" in robot.overrides[0]
    assert any("overrides: joint1: limits stand in" in warning for warning in made.inspection.warnings)


def test_every_guess_is_marked_until_somebody_has_looked(tmp_path: Path) -> None:
    made, _ = drafted(tmp_path, single())
    assert any("GUESS stands in lines" in warning for warning in made.inspection.warnings)
    file = made.folder / "robot.toml"
    file.write_text(file.read_text().replace("GUESS", ""))
    assert load_robot(made.folder).dim == 7
    readme = (made.folder / "README.md").read_text()
    assert "- [ ] Forward kinematics: `python -m robots fk mine arm Q...`" in readme


def test_what_a_urdf_calls_itself_is_the_title(tmp_path: Path) -> None:
    source = write(tmp_path, single())
    source.write_text(
        source.read_text().replace('robot name="made_up"', 'robot name="L&apos;arm &quot;é&quot; \\n"')
    )
    assert load_robot(draft_robot("mine", source, tmp_path / "into").folder).title == 'L\'arm "é" \\n'


def test_a_gripper_alone_is_a_hand(tmp_path: Path) -> None:
    body = base() + jaws("base_link")
    made = draft_robot("mine", write(tmp_path / "from", body), tmp_path / "into")
    (group,) = load_robot(made.folder).groups
    assert (group.kind, group.joints, group.chain) == ("hand", ("finger_joint1",), None)


def test_a_floating_base_is_left_out_and_said_to_be(tmp_path: Path) -> None:
    free = link("world") + joint("free", "world", "base_link", kind="floating", more="")
    made, robot = drafted(tmp_path, free + single())
    assert robot.dim == 7
    assert "planar, and held where the URDF draws them: free" in (made.folder / "robot.toml").read_text()
    assert "free: floating or planar joints" in (made.folder / "README.md").read_text()


def test_a_refused_draft_names_the_file_that_was_given(tmp_path: Path) -> None:
    odd = '<visual><origin xyz="0 x 0"/><geometry><sphere radius="0.1"/></geometry></visual>'
    body = single() + link("lamp", odd) + joint("bolt", "base_link", "lamp", kind="fixed")
    source = write(tmp_path / "from", body)
    with pytest.raises(RobotError, match="origin xyz is '0 x 0'") as refused:
        draft_robot("mine", source, tmp_path / "into")
    assert str(source) in str(refused.value)
    assert ".mine-" not in str(refused.value)


def test_a_refused_draft_leaves_nothing_behind(tmp_path: Path) -> None:
    into = tmp_path / "into"
    body = base() + link("lamp") + joint("bolt", "base_link", "lamp", kind="fixed")
    with pytest.raises(RobotError, match="no joint moves by itself"):
        draft_robot("mine", write(tmp_path, body), into)
    assert list(into.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("My-Robot", "'My-Robot' is no name for a robot; allowed: a letter, then"),
        ("../mine", "is no name for a robot"),
        ("ur5e", "there is a robot 'ur5e' already"),
    ],
)
def test_a_name_that_cannot_be_is_refused(tmp_path: Path, name: str, said: str) -> None:
    with pytest.raises(RobotError, match=said):
        draft_robot(name, write(tmp_path, single()), tmp_path / "into")


def test_nothing_is_written_over(tmp_path: Path) -> None:
    drafted(tmp_path, single())
    with pytest.raises(RobotError, match="into/mine is there already; allowed: a new folder"):
        draft_robot("mine", tmp_path / "from" / "made_up.urdf", tmp_path / "into")


@pytest.mark.some(1)
@pytest.mark.parametrize("robot", ["agilex_piper", "dual_franka", "agibot_g2"])
def test_a_urdf_of_ours_gives_a_robot_with_the_same_kinematics(tmp_path: Path, robot: str) -> None:
    described = load_robot(robot)
    made = draft_robot("mine", described.urdf, tmp_path)
    assert made.inspection.errors == ()
    ours, first = load_robot(made.folder).arms[0], described.arms[0]
    assert ours.chain is not None
    assert first.chain is not None
    assert (ours.urdf_joints, ours.eef_link, ours.frame) == (first.urdf_joints, first.eef_link, first.frame)
    q = np.full(ours.chain.size, 0.3)
    np.testing.assert_array_equal(ours.chain.pose(q), first.chain.pose(q))


def test_new_says_what_it_made_and_what_comes_next(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("EVA_ROBOTS", str(tmp_path / "robots"))
    source = write(tmp_path, single())
    assert main(["new", "mine", "--urdf", str(source)]) == 0
    shown = capsys.readouterr().out
    assert f"drafted: {tmp_path / 'robots' / 'mine'}" in shown
    assert "python -m robots check mine" in shown
    assert "EVA_ROBOTS=" not in shown
    assert main(["check", "mine"]) == 0
    assert main(["fk", "mine", "arm", *["0"] * 6]) == 0
    answer = json.loads(capsys.readouterr().out.splitlines()[-1])
    np.testing.assert_allclose(answer["position"], [0, 0, 0.7], atol=1e-9)


def test_new_outside_of_eva_robots_says_how_it_is_found(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("EVA_ROBOTS", raising=False)
    source = write(tmp_path, link("base_link") + arm("base_link", visual=False))
    assert main(["new", "mine", "--urdf", str(source), "--into", str(tmp_path / "here")]) == 0
    shown = capsys.readouterr().out
    assert f"EVA_ROBOTS={tmp_path / 'here'}" in shown
    assert "stand in for base_link, link1" in shown


def test_new_refuses_a_xacro_and_says_what_makes_a_urdf_of_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = tmp_path / "arm.urdf.xacro"
    source.write_text(
        '<robot name="a" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:arm prefix="x"/></robot>'
    )
    assert main(["new", "mine", "--urdf", str(source), "--into", str(tmp_path)]) == 1
    assert "this is a xacro, of which a URDF is yet to be made: xacro arm.urdf.xacro > arm.urdf" in (
        capsys.readouterr().err
    )


def test_a_robot_that_is_not_among_ours_stands_where_its_maker_says(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The UFACTORY xArm 6 at zero: 207 mm ahead, 112 mm up, pointing down, as its manual gives it."""
    source = Path(__file__).with_name("xarm6.urdf")
    assert main(["new", "my_xarm", "--urdf", str(source), "--into", str(tmp_path)]) == 0
    folder = tmp_path / "my_xarm"
    file = folder / "robot.toml"
    text = file.read_text()
    assert 'eef_link = "link_tcp"' in text
    assert "tip = { xyz = [0.0, 0.0, 0.0]" in text  # nothing shows where fingers end: where the URDF says
    file.write_text(text.replace('eef_link = "link_tcp"', 'eef_link = "link6"'))
    assert (
        "shapes: 14 meshes were not found or cannot be read, package://xarm_desc" in capsys.readouterr().out
    )
    assert main(["fk", str(folder), "arm", *["0"] * 6]) == 0
    answer = json.loads(capsys.readouterr().out)
    np.testing.assert_allclose(answer["position"], [0.207, 0.0, 0.112], atol=5e-4)
    np.testing.assert_allclose(np.abs(answer["wxyz"]), [0, 1, 0, 0], atol=1e-6)  # turned half round x
    gripper = load_robot(folder).arms[0].gripper
    assert gripper is not None
    assert (gripper.open, gripper.close, gripper.unit) == (0.0, 0.85, "rad")
    assert gripper.apart == pytest.approx((0.0, 0.085), abs=0.012)  # the maker says 0 to 85 mm
