"""A robot of everything at once: a torso that slides and turns carries an arm of seven and one of four joints.

The longer one has a joint without limits, one that slides and one that mimics another.
"""

from __future__ import annotations

from pathlib import Path

from robots import Robot, load_robot


def _limit(lower: float, upper: float, velocity: float) -> str:
    return f'<limit lower="{lower}" upper="{upper}" velocity="{velocity}"/>'


_MIMIC = '<mimic joint="l4" multiplier="-0.5" offset="0.1"/>'
_JOINTS = [  # name, kind, parent, child, origin xyz, rpy, axis, further
    ("lift", "prismatic", "base", "torso", "0 0 0.6", "0 0 0", "0 0 1", _limit(0, 0.4, 0.2)),
    ("twist", "revolute", "torso", "chest", "0 0 0.2", "0.1 0 0", "0 0 1", _limit(-1, 1, 1)),
    ("l1", "continuous", "chest", "left1", "0 0.2 0.1", "-0.4 0 0", "0 1 0", '<limit velocity="2"/>'),
    ("l2", "revolute", "left1", "left2", "0.1 0 0", "0 0.3 0", "0 0 -1", _limit(-2, 2, 2)),
    ("l3", "prismatic", "left2", "left3", "0.1 0 0", "0 0 0.2", "1 0 0", _limit(0, 0.3, 0.5)),
    ("l4", "revolute", "left3", "left4", "0.1 0 0", "0 0 0", "0 1 0", _limit(-2, 2, 3)),
    ("follows", "revolute", "left4", "left5", "0.2 0 0", "0 0 0", "0 1 0", _MIMIC),
    ("l5", "revolute", "left5", "left6", "0.1 0 0", "0 0 0", "1 0 0", _limit(-3, 3, 3)),
    ("l6", "revolute", "left6", "left7", "0.1 0 0", "0 0 0", "0 1 1", _limit(-2, 2, 3)),
    ("l7", "revolute", "left7", "left8", "0.05 0 0", "0 0 0", "0 0 1", _limit(-2, 2, 3)),
    ("left_mount", "fixed", "left8", "left_tool", "0.1 0 0.02", "0 0.5 0", "1 0 0", ""),
    ("r1", "revolute", "chest", "right1", "0 -0.2 0.1", "0.4 0 0", "0 1 0", _limit(-2, 2, 2)),
    ("r2", "revolute", "right1", "right2", "0.2 0 0", "0 0 0", "0 0 1", _limit(-2, 2, 2)),
    ("r3", "revolute", "right2", "right3", "0.2 0 0", "0 0 0", "0 1 0", _limit(-2, 2, 2)),
    ("r4", "revolute", "right3", "right4", "0.2 0 0", "0 0 0", "1 0 0", _limit(-2, 2, 2)),
]  # fmt: skip

_DESCRIPTION = """
title = "A crane"
urdf = "crane.urdf"
limits_source = "invented for tests"
control_rate = 50.0
cameras = { front = "front" }

[[groups]]
name = "left"
joints = ["j1", "j2", "j3", "j4", "j5", "j6", "j7"]
urdf_joints = ["l1", "l2", "l3", "l4", "l5", "l6", "l7"]
frame = "base"
eef_link = "left_tool"
overrides = []

[[groups]]
name = "torso"
joints = ["lift", "twist"]
urdf_joints = ["lift", "twist"]

[[groups]]
name = "right"
joints = ["j1", "j2", "j3", "j4"]
urdf_joints = ["r1", "r2", "r3", "r4"]
frame = "base"
eef_link = "right4"

[poses]
home = { left = [0.3, 0.2, 0.1, 0.5, 0.2, 0.6, -0.3], torso = [0.1, 0.2], right = [0.3, 0.4, 0.5, 0.1] }
"""


def crane(folder: Path) -> Robot:
    """The crane, described in `folder`; vectors are left 7, torso 2, right 4."""
    links = {name for joint in _JOINTS for name in joint[2:4]}
    joints = "".join(
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>{further}</joint>'
        for name, kind, parent, child, xyz, rpy, axis, further in _JOINTS
    )
    tree = "".join(f'<link name="{link}"/>' for link in sorted(links)) + joints
    (folder / "crane.urdf").write_text(f'<robot name="crane">{tree}</robot>', "utf-8")
    (folder / "robot.toml").write_text(_DESCRIPTION, "utf-8")
    return load_robot(folder)
