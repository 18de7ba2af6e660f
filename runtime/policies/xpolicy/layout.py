"""Observations of the XPolicyLab protocol (format v1.0) from ours, and rows from its actions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from runtime.core.errors import ActionSpaceError, ConfigurationError, ShapeError
from runtime.core.types import Float32, Observation
from runtime.policies.action_layout import ActionLayoutSettings
from runtime.policies.action_rows import parse_action_rows
from runtime.policies.gripper_convention import Convention, GripperConvention
from runtime.policies.request_layout import pose_rows_for
from runtime.policies.xpolicy.robot_keys import (
    SINGLE_ARM_JOINTS,
    Parts,
    Side,
    arm_prefixes,
    joint_parts,
    pose_parts,
    require_arms_alone,
    require_wire_pose,
)

if TYPE_CHECKING:
    from robots import Robot

Slot = Literal["cam_head", "cam_left_wrist", "cam_right_wrist", "cam_wrist", "cam_third_view"]
FORMAT = "v1.0"
_KINDS = "fiu"  # numbers
_MOST_STEPS = 10_000  # of a response; a message can have many more, whose reading would outlast the deadline
_MEANINGS = ("joint_state", "ee_pose", "tcp_pose")  # ends of the protocol's keys for arms


class LayoutSettings(ActionLayoutSettings):
    """Cameras, arms and grippers in observations and actions.

    The state always has the joints; with observation_space = "eef" it has the poses, too.
    """

    cameras: dict[str, Slot] = Field(default_factory=dict)
    """Observation key = slot of the picture: "cam_head", "cam_left_wrist", "cam_right_wrist", "cam_wrist" or
    "cam_third_view"."""
    arms: dict[str, Side] | None = None
    """Group = side of each arm, "left" or "right". Absent: a single arm has keys without prefix, and two arms are told
    apart by the beginning of their names."""
    single_arm_joints: Literal["arm_joint_state", "joint_state"] = "arm_joint_state"
    """Name under which the joints of a single arm are sent; in responses both names are understood."""
    gripper: Convention = "robot"
    """Gripper convention in state and responses, because the protocol has none: "robot": the robot's own values;
    "droid": 0 is open and 1 is closed."""
    ignored_actions: list[str] = Field(default_factory=list)
    """Action keys of the server that this robot does not use."""


class Layout:
    """Converter of observations and actions. Raises ConfigurationError if a setting does not fit the robot."""

    def __init__(self, settings: LayoutSettings, robot: Robot, control_rate: float) -> None:
        _check_slots(settings.cameras, robot)
        _, self._width = settings.widths(robot)
        self._settings = settings
        self._frequency = settings.action_rate or control_rate
        self._inputs = settings.layout(robot, dict(settings.cameras))
        prefixes = arm_prefixes(settings.arms, robot)
        self._joints = joint_parts(prefixes, robot, settings.single_arm_joints)
        self._poses: Parts = {}
        if settings.observation_space == "eef":
            require_wire_pose(settings.observation_pose, "policy.observation_pose")
            poses_sent = pose_parts(prefixes, robot, settings.observation_pose)
            self._poses = {key: dims for key, dims in poses_sent.items() if key not in self._joints}
        poses = pose_rows_for(settings.action_space, settings.action_pose, robot, "action_pose")
        if poses is None:
            require_arms_alone(robot)
            self.actions = joint_parts(prefixes, robot, "arm_joint_state")
        else:
            require_wire_pose(settings.action_pose, "policy.action_pose")
            self.actions = pose_parts(prefixes, robot, settings.action_pose, settings.action_mode)
        _check_ignored(settings.ignored_actions, self.actions)
        self._grip = GripperConvention(settings.gripper, robot, poses)

    def observation(self, observation: Observation) -> dict[str, Any]:
        """Return the observation of a request. Raises PolicyError if a part is missing."""
        shown = self._grip.convert_observation(observation)
        inputs = self._inputs.build(shown)
        joints = np.asarray(shown.qpos, np.float32)
        state = {key: joints[dims] for key, dims in self._joints.items()}
        state |= {key: inputs["state"][dims] for key, dims in self._poses.items()}
        return {
            "data_format_version": FORMAT,
            "instruction": observation.prompt,
            "env_idx": 0,
            "additional_info": {"frequency": self._frequency},
            "vision": {
                slot: {"color": picture, "shape": list(picture.shape[:2])}
                for slot, picture in inputs["images"].items()
            },
            "state": state,
        }

    def rows(self, actions: object) -> Float32:
        """Return rows float32 [H, W] from the actions of a response: a list with a map of keys for each step.

        Raises ShapeError, NotFiniteError, or ActionSpaceError for keys of another space or mode than declared.
        """
        if not isinstance(actions, list):
            raise ShapeError(
                f"actions is a {type(actions).__name__}; expected a list with a map for each step"
            )
        if not actions:
            raise ShapeError("actions is empty; expected at least one step")
        if len(actions) > _MOST_STEPS:
            raise ShapeError(f"actions has {len(actions)} steps; expected at most {_MOST_STEPS}")
        steps = [self._step(number, given) for number, given in enumerate(actions)]
        rows = np.zeros((len(steps), self._width), np.float32)  # zeros for an arm without gripper
        for key, dims in self.actions.items():
            column = np.stack([_numbers(step[key], key, n, len(dims)) for n, step in enumerate(steps)])
            rows[:, dims] = parse_action_rows(f"action {key!r}", column, len(dims))
        return self._grip.to_robot(rows)

    def _step(self, number: int, given: object) -> dict[str, Any]:
        """Return the values of one step by their keys here, which must be exactly those that are expected."""
        if not isinstance(given, Mapping):
            raise ShapeError(
                f"step {number} of actions is a {type(given).__name__}; expected a map with "
                f"{', '.join(self.actions)}"
            )
        step = {str(key): value for key, value in given.items() if key not in self._settings.ignored_actions}
        arm, other = SINGLE_ARM_JOINTS
        if arm in self.actions and arm not in step and other in step:
            step[arm] = step.pop(other)
        missing = [key for key in self.actions if key not in step]
        unknown = [key for key in step if key not in self.actions]
        if missing or unknown:
            self._refuse(number, missing, unknown)
        return step

    def _refuse(self, number: int, missing: list[str], unknown: list[str]) -> None:
        """Raise the error for keys that are missing or not expected."""
        settings = self._settings
        problems = [f"no {', '.join(missing)}"] if missing else []
        problems += [f"the unexpected {', '.join(unknown)}"] if unknown else []
        text = f"step {number} of actions has {' and '.join(problems)}; expected {', '.join(self.actions)}"
        declared = (
            f"policy.action_space = {settings.action_space!r}, policy.action_mode = {settings.action_mode!r}"
        )
        if any(key.endswith("delta_ee_pose") for key in unknown):
            raise ActionSpaceError(
                f"{text}: these change poses, {declared}; allowed for them: 'eef' with 'delta' or 'relative'; or "
                "list their keys in policy.ignored_actions"
            )
        if any(key.endswith(_MEANINGS) for key in unknown):
            raise ActionSpaceError(
                f"{text}: {declared}; correct them, policy.arms, or list the keys in policy.ignored_actions"
            )
        raise ShapeError(f"{text}; a key without use is allowed in policy.ignored_actions")


def _check_slots(cameras: Mapping[str, Slot], robot: Robot) -> None:
    if not cameras or len(set(cameras.values())) != len(cameras):
        raise ConfigurationError(
            f"policy.cameras = {dict(cameras)}; allowed: a slot for each view of the training, no slot twice; cameras "
            f"of {robot.name}: {', '.join(camera.key for camera in robot.cameras)}"
        )


def _check_ignored(ignored: list[str], actions: Parts) -> None:
    used = [key for key in ignored if key in actions]
    if used:
        raise ConfigurationError(
            f"policy.ignored_actions names {', '.join(used)}, which this robot needs; allowed: keys other than "
            f"{', '.join(actions)}"
        )


def _numbers(value: object, key: str, number: int, width: int) -> NDArray[Any]:
    """Return the numbers of one key at one step. Raises ShapeError."""
    try:
        numbers = np.asarray(value)
    except ValueError:  # lists of different lengths
        numbers = np.asarray(None)
    if numbers.dtype.kind not in _KINDS or not isinstance(value, list | np.ndarray):
        raise ShapeError(
            f"action {key!r} of step {number} is a {type(value).__name__} that is no array of numbers; expected {width}"
            " numbers"
        )
    if numbers.shape != (width,):
        raise ShapeError(
            f"action {key!r} of step {number} has the shape {list(numbers.shape)}; this robot needs [{width}]"
        )
    return numbers
