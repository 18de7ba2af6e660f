"""Robots as data, in one folder each with robot.toml, URDF and README; loader, kinematics, collision check."""

from robots.body import Body
from robots.chain import Chain
from robots.errors import RobotError
from robots.grippers import GripperChoice
from robots.loading import is_described, load_robot, load_robot_with_optional_groups, robot_names
from robots.robot import EEF_FIELDS, Camera, Gripper, Group, Robot
from robots.visuals import RobotScene, Visual, scene_of

__all__ = [
    "EEF_FIELDS",
    "Body",
    "Camera",
    "Chain",
    "Gripper",
    "GripperChoice",
    "Group",
    "Robot",
    "RobotError",
    "RobotScene",
    "Visual",
    "is_described",
    "load_robot",
    "load_robot_with_optional_groups",
    "robot_names",
    "scene_of",
]
