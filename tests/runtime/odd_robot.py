"""A robot with everything that the bundled ones lack: an arm without gripper, and groups that are no arms."""

from __future__ import annotations

import shutil
from pathlib import Path

import robots
from robots import Robot

_TABLE = """
title = "Two arms, one without a gripper; a neck, and a hand that closes by itself"
urdf = "agilex_piper.urdf"
limits_source = "made up"
control_rate = 30.0
mount_frame = "bench"

[cameras]
front = "cam_high"

[[groups]]
name = "neck"
joints = ["pan", "tilt"]
urdf_joints = ["", ""]
mount = { xyz = [0.3, -0.1, 0.2], wxyz = [0.6, 0.0, 0.8, 0.0] } # of the copy of the URDF that it shares
overrides = [
  { joint = "pan", lower = -2.0, upper = 2.0, velocity = 1.0, reason = "made up" },
  { joint = "tilt", lower = -1.0, upper = 1.0, velocity = 1.0, reason = "made up" },
]

[[groups]]
name = "bare"
joints = ["j1", "j2", "j3", "j4", "j5", "j6"]
urdf_joints = ["joint1", "joint2", "joint3", "joint4", "joint5", "joint6"]
frame = "base_link"
eef_link = "gripper_base"
mount = { xyz = [0.3, -0.1, 0.2], wxyz = [0.6, 0.0, 0.8, 0.0] }

[[groups]]
name = "armed"
joints = ["j1", "j2", "j3", "j4", "j5", "j6", "jaw"]
urdf_joints = ["joint1", "joint2", "joint3", "joint4", "joint5", "joint6"]
frame = "base_link"
eef_link = "gripper_base"
mount = { xyz = [-0.3, 0.0, 0.0], wxyz = [0.7071067811865476, 0.0, 0.0, 0.7071067811865476] }
gripper = { index = 6, unit = "m", lower = 0.0, upper = 0.1, open = 0.1, close = 0.0, velocity = 1.0 }

[[groups]]
name = "hand"
joints = ["wrist", "grasp"]
urdf_joints = [""]
overrides = [{ joint = "wrist", lower = -9.0, upper = 9.0, velocity = 1.0, reason = "made up" }]
[groups.gripper]
index = 1
unit = "part"
lower = 0.0
upper = 1.0
open = 1.0
close = 0.0
velocity = 5.0
binary = true
threshold = 0.5

[poses.home]
neck = [0.0, 0.0]
bare = [0.0, 1.2, -1.0, 0.3, 0.4, 0.2]
armed = [0.1, 1.0, -0.9, -0.3, 0.5, 0.1, 0.05]
hand = [0.0, 1.0]
"""


def odd_robot(folder: Path) -> Robot:
    """The robot, described in `folder`; D = 17, arms "bare" and "armed"."""
    place = folder / "odd"
    place.mkdir()
    shutil.copy(robots.load_robot("agilex_piper").urdf, place)
    (place / "robot.toml").write_text(_TABLE)
    return robots.load_robot(str(place))
