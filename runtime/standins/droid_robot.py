"""Robot in the conventions of DROID's policies.

Grippers are separate from the joints, 0 open and 1 closed; actions are positions or velocities.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from runtime.core.errors import SetupError
from runtime.core.types import Float32, Float64, UInt8
from runtime.simulation.bench.bench import camera_arm

if TYPE_CHECKING:
    from robots import Robot

_JOINT_STEP = 0.2  # [rad] per row at a velocity of 1


class DroidRobot:
    """Converter between requests in DROID's format and a script that uses the robot's own joints.

    `numbering` is the number of the first exterior view in requests, 0 or 1.

    Raises:
        SetupError: If `space` is not joint_position or joint_velocity.
    """

    def __init__(self, robot: Robot, space: str, numbering: int) -> None:
        if space not in ("joint_position", "joint_velocity"):
            raise SetupError(f"--space {space}; the stand-in plays joint_position or joint_velocity")
        self._robot = robot
        self._velocity = space == "joint_velocity"
        self._first = numbering
        self._joints = [dim for dim in range(robot.dim) if dim not in robot.gripper_dims]
        grippers = [group.gripper for group in robot.groups if group.gripper is not None]
        self._ends = [(gripper.open, gripper.close) for gripper in grippers]
        self._wrists = [camera.key for camera in robot.cameras if camera_arm(robot, camera) is not None]
        self._above = [camera.key for camera in robot.cameras if camera_arm(robot, camera) is None]

    def joints(self, message: Mapping[str, Any]) -> Float64:
        """Return the robot's joints [D] in a request.

        Raises:
            KeyError: If the request lacks them.
            ValueError: If their number is not that of this robot.
        """
        angles = np.asarray(message["observation/joint_position"], np.float64)
        grips = np.asarray(message["observation/gripper_position"], np.float64)
        if angles.shape != (len(self._joints),) or grips.shape != (max(1, len(self._ends)),):
            raise ValueError(
                f"joint_position {angles.shape} and gripper_position {grips.shape} are another robot's"
            )
        q = np.zeros(self._robot.dim)
        q[self._joints] = angles
        for dim, grip, (wide, shut) in zip(self._robot.gripper_dims, grips, self._ends, strict=False):
            q[dim] = wide + grip * (shut - wide)
        return q

    def pictures(self, message: Mapping[str, Any]) -> dict[str, UInt8]:
        """Return the newest image of each view by the key of the robot's camera."""
        pairs = [
            (f"observation/exterior_image_{self._first + n}_left", key) for n, key in enumerate(self._above)
        ]
        pairs += [("observation/wrist_image_left", key) for key in self._wrists[:1]]
        available = {key: message[name] for name, key in pairs if name in message}
        return {key: picture if picture.ndim == 3 else picture[-1] for key, picture in available.items()}

    def rows(self, targets: Float32, q: Float64) -> Float32:
        """Convert the script's targets [H, D], planned from joints `q` [D], to rows of this server."""
        rows = targets.astype(np.float64)
        if self._velocity:
            before = np.concatenate([q[None], rows[:-1]])[:, self._joints]
            rows[:, self._joints] = np.clip((rows[:, self._joints] - before) / _JOINT_STEP, -1.0, 1.0)
        for dim, (wide, shut) in zip(self._robot.gripper_dims, self._ends, strict=True):
            rows[:, dim] = (targets[:, dim] - wide) / (shut - wide)
        return rows.astype(np.float32)
