"""Scripted policy that answers in poses: the joint rows of another script, converted to a declared pose format."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from pydantic import ValidationError

from runtime.core.errors import RuntimeFault, SetupError
from runtime.core.pose_format import PoseFormat
from runtime.core.types import EEF_WIDTH, Float32, Float64, UInt8
from runtime.simulation.scripts.script import Answer, Script
from runtime.spaces.pose_rows import PoseRows

if TYPE_CHECKING:
    from robots import Group, Robot


class PoseScript(Script):
    """Script that answers requests as another script does, but in poses.

    The joint rows in the answers of the other script are converted to poses. The metadata declare the format of the
    rows; `rate` [Hz] is the rate of the rows.

    Raises:
        SetupError: If the format does not fit the robot.
    """

    def __init__(self, script: Script, robot: Robot, rate: float, pose: PoseFormat) -> None:
        self._script = script
        self._robot = robot
        self._rows = _rows(pose, robot)
        self.metadata: Mapping[str, object] = {
            **script.metadata,
            "action_space": "eef",
            "action_dim": self._rows.width,
            "action_rate": rate,
            "action_pose": pose.model_dump(),
        }

    def begin(self) -> Answer:
        """Return the function that answers the requests of a new connection in poses."""
        answer = self._script.begin()

        def posed(q: Float64, pictures: Mapping[str, UInt8], prompt: str) -> Float32:
            return self.to_poses(answer(q, pictures, prompt).astype(np.float64), q)

        return posed

    def to_poses(self, joints: Float64, q: Float64) -> Float32:
        """Return pose rows float32 [H, width] for joint rows [H, D].

        Joints that move a declared frame are taken from `q` [D], unless the rows contain them after the poses.
        """
        vectors = np.stack([_vectors(arm, joints) for arm in self._robot.arms], axis=1)
        at = np.tile(q, (len(joints), 1))
        at[:, self._rows.dims] = joints[:, self._rows.dims]
        return self._rows.encode(vectors, at).astype(np.float32)


def pose_format(assignments: Sequence[str]) -> PoseFormat:
    """Return the pose format described by texts "key=value", with values as in a deployment.

    Raises:
        SetupError: If an assignment is invalid; the message names it.
    """
    fields = {}
    for text in assignments:
        key, equals, value = text.partition("=")
        if not equals:
            raise SetupError(f"--pose {text}; allowed: KEY=VALUE with {', '.join(PoseFormat.model_fields)}")
        fields[key.strip()] = _value(value)
    try:
        return PoseFormat.model_validate(fields)
    except (ValidationError, RuntimeFault) as error:
        raise SetupError(f"--pose {' '.join(assignments)}: {error}") from None


def _value(text: str) -> object:
    """Parse a TOML value; other text is returned as it is, so that names need no quotes."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text.strip()


def _rows(pose: PoseFormat, robot: Robot) -> PoseRows:
    try:
        return PoseRows(pose, robot, "--pose")
    except RuntimeFault as fault:
        raise SetupError(str(fault)) from None


def _vectors(arm: Group, joints: Float64) -> Float64:
    """Return the end-effector vectors [H, 8] of one arm for joint rows [H, D]; without a gripper the last
    number is 0.
    """
    vectors = np.zeros((len(joints), EEF_WIDTH))
    vectors[:, : EEF_WIDTH - 1] = arm.pose(joints)
    if arm.gripper_dim is not None:
        vectors[:, EEF_WIDTH - 1] = joints[:, arm.gripper_dim]
    return vectors
