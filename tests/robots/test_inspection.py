from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from robots import RobotError, robot_names
from robots.inspection import Inspection, inspect_robot

Edit = Callable[..., Path]
FAST = '[[groups.overrides]]\njoint = "joint5"\nvelocity = 20.0\nreason = "a placeholder"\n\n[groups.mount]'


def said(found: Inspection, part: str) -> str:
    """The one line or warning that has this in it."""
    matches = [line for line in (*found.lines, *found.warnings) if part in line]
    assert len(matches) == 1, matches
    return matches[0]


@pytest.mark.some(2)
@pytest.mark.parametrize("name", robot_names())
def test_every_robot_is_told_whole(name: str) -> None:
    found = inspect_robot(name)
    text = "\n".join(found.lines)
    for word in (
        "numbers, ",
        "groups: ",
        "cameras: ",
        "limits: ",
        "poses: home",
        "stands in the scene at",
        "ros",
    ):
        assert word in text


def test_everything_that_a_person_wants_to_know_is_in_its_lines() -> None:
    found = inspect_robot("agilex_piper")
    assert found.errors == ()
    assert said(found, "left_arm.joint1 ").split("(")[1].startswith("URDF joint2)")
    assert "left_arm (arm): 7 numbers" in found.lines
    assert "  gripper in m: open 0.1, close 0, any value between" in found.lines
    assert "  fingers 0 mm apart when closed, 100 mm when open; drawn: joint7" in found.lines
    assert (
        "  fingertips at 0.0000, 0.0000, 0.1358 m in gripper_base, pointing along 0.0000, 0.0000, 1.0000"
        in (found.lines)
    )
    assert said(found, "a copy of base_link for right_arm at 0.25, 0, 0 m")
    assert "poses.home: left_arm.joint1, left_arm.joint2" in said(found, "on a limit, where")


def test_optional_groups_are_looked_at_too(edited: Edit) -> None:
    folder = edited(
        ('name = "left_arm"', 'name = "left_arm"\noptional = true'),
        ("left_arm = [0.0,", "left_arm = [9.0,"),
    )
    with pytest.raises(RobotError, match=r"poses\.home\.left_arm: joint0 = 9\.0; allowed"):
        inspect_robot(folder)


def test_what_somebody_should_look_at_is_a_warning(edited: Edit) -> None:
    folder = edited(
        ("[groups.mount]", FAST),
        ("[poses.ready]", "[poses.other]"),
        ('unit = "m"', 'unit = "counts"'),
        ("control_rate = 30.0 #", "control_rate = 30.0 # GUESS:"),
    )
    (folder / "README.md").unlink()
    found = inspect_robot(folder)
    assert found.errors == ()
    assert said(found, 'no "ready"')
    assert "left_arm.overrides: joint5" in said(found, "placeholders, or are some")
    assert "left_arm.joint5: faster than 10 rad/s" in said(found, "faster than")
    assert "groups.left_arm.gripper.apart: not given" in said(found, ".apart")
    assert said(found, "no README.md")
    assert "GUESS stands in lines 4: verify" in said(found, "GUESS")
    assert all(warning.startswith(f"{folder}/robot.toml: ") for warning in found.warnings)
    assert "overridden for joint5: a placeholder" in said(found, "overridden for")
    assert "(URDF joint6; overridden: velocity)" in said(found, "left_arm.joint5  ")


def test_a_joint_without_an_end_is_a_warning(edited: Edit) -> None:
    folder = edited()
    file = folder / "agilex_piper.urdf"
    before, after = file.read_text().split('<joint name="joint6" type="revolute">')
    file.write_text(before + '<joint name="joint6" type="continuous">' + after)
    endless = [warning for warning in inspect_robot(folder).warnings if "no position limit" in warning]
    assert ["left_arm: joint5" in endless[0], "right_arm: joint5" in endless[1]] == [True, True]


def test_poses_at_which_links_touch_are_errors(edited: Edit) -> None:
    found = inspect_robot(edited(('["link2", "link4"], ', "")))
    assert len(found.errors) == 2
    assert "robot.toml: poses.home: left_arm/link2 and left_arm/link4 are -18 mm apart" in found.errors[0]


def test_a_mesh_that_is_missing_is_an_error(edited: Edit) -> None:
    folder = edited()
    file = folder / "agilex_piper.urdf"
    text = file.read_text()
    box = text[text.index("<geometry>") : text.index("</geometry>")]
    file.write_text(text.replace(box, '<geometry><mesh filename="meshes/gone.stl"/>', 1))
    with pytest.raises(RobotError, match=r"'meshes/gone\.stl' is missing; looked for"):
        inspect_robot(folder)


def test_fingertips_below_the_table_are_a_warning(edited: Edit) -> None:
    found = inspect_robot(
        edited(("[cameras]", "[stand]\nxyz = [0.0, 0.0, -0.3]\nwxyz = [1.0, 0.0, 0.0, 0.0]\n[cameras]"))
    )
    low = [warning for warning in found.warnings if "below the table; see stand" in warning]
    assert "poses.home: the fingertips of left_arm are 75 mm below" in low[0]
    assert len(low) == 4
