"""Settings of state and action rows for protocols whose server does not state their meaning."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Literal

from runtime.core.pose_format import PoseFormat
from runtime.core.types import ActionChunk, Float32, Space
from runtime.policies.pictures import Resize
from runtime.policies.request_layout import (
    RequestLayout,
    RequestSettings,
    Size,
    pose_rows_for,
)

if TYPE_CHECKING:
    from robots import Robot


from typing import Annotated

from pydantic import Field

from runtime.core.settings import Settings
from runtime.core.types import ActionMode, RelativeFrame

Rate = Annotated[float, Field(ge=1, le=1000)]


class ActionFormatSettings(Settings):
    """Space, format, mode and rate of the rows of an answer."""

    action_space: Space = "joint"
    """Content of the rows of a response: joint targets, or end-effector poses ("eef")."""
    action_pose: PoseFormat = PoseFormat()
    """Format of the poses in a response, with action_space = "eef"."""
    action_mode: ActionMode = "absolute"
    """Meaning of the values of a row: "absolute" targets, "relative" to the observation, or a "delta" to the previous
    row.

    Grippers are absolute in every mode. A server's own metadata key action_mode names the space, not this mode."""
    relative_frame: RelativeFrame = "base"
    """Axes of relative poses: "base": the frame in which poses are declared; "tool": the end effector as observed."""
    action_rate: Rate | None = None
    """Rows per second of a response [Hz]; absent: the control rate."""


class ActionLayoutSettings(ActionFormatSettings):
    """Meaning of the values of the state and of the rows, and format of the images."""

    observation_space: Space = "joint"
    """Content of the state: joints, or end-effector poses ("eef")."""
    observation_pose: PoseFormat = PoseFormat()
    """Format of the poses in the state, with observation_space = "eef"."""
    observation_eef: Literal["measured", "fk"] = "measured"
    """Source of the poses in the state and of the reference of relative poses: "measured" by the robot if it measures
    them, else computed from the joints; "fk": always computed from the joints."""
    image_size: Size | None = None
    """Height and width to which images are resized [pixels]; absent: they are not resized."""
    resize: Resize = "pad"
    """With image_size: "pad" preserves the aspect ratio and fills with black, "stretch" does not preserve it."""

    @property
    def uses_poses(self) -> bool:
        """True if the responses depend on the poses of an observation."""
        relative = self.action_space == "eef" and self.action_mode != "absolute"
        return self.observation_space == "eef" or relative

    def layout(self, robot: Robot, cameras: dict[str, str]) -> RequestLayout:
        """Return the layout of requests: "state" float32 [W], "images" (HWC, with the names in `cameras`) and
        "prompt".
        """
        settings = RequestSettings(
            observation_space=self.observation_space,
            observation_pose=self.observation_pose,
            observation_eef=self.observation_eef,
            cameras=cameras,
            image_size=self.image_size,
            resize="none" if self.image_size is None else self.resize,
            image_layout="hwc",
        )
        return RequestLayout(settings, robot)

    def widths(self, robot: Robot) -> tuple[int, int]:
        """Return the numbers of values of the state and of a row of actions.

        Raises ConfigurationError if a format does not fit the robot.
        """
        state = pose_rows_for(self.observation_space, self.observation_pose, robot, "observation_pose")
        rows = pose_rows_for(self.action_space, self.action_pose, robot, "action_pose")
        return robot.dim if state is None else state.width, robot.dim if rows is None else rows.width

    def chunk(self, rows: Float32, timing: Mapping[str, float]) -> ActionChunk:
        """Return the rows [H, W] as a chunk with the space, mode, rate, frame and pose format of these settings."""
        return ActionChunk(
            actions=rows,
            space=self.action_space,
            rate=self.action_rate,
            timing=timing,
            mode=self.action_mode,
            frame=self.relative_frame,
            pose=self.action_pose,
        )
