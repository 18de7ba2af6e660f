"""Settings of state and action rows for protocols whose server does not state their meaning."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Literal

from runtime.core.pose_format import PoseFormat
from runtime.core.types import ActionChunk, Float32, Space
from runtime.policies.answers import ActionFormatSettings
from runtime.policies.pictures import Resize
from runtime.policies.request_layout import (
    RequestLayout,
    RequestSettings,
    Size,
    pose_rows_for,
)

if TYPE_CHECKING:
    from robots import Robot


class ActionLayoutSettings(ActionFormatSettings):
    """Meaning of the numbers of state and rows, and form of pictures."""

    observation_space: Space = "joint"
    """What the state is: joints, or poses."""
    observation_pose: PoseFormat = PoseFormat()
    """How poses are written in the state, where observation_space is "eef"."""
    observation_eef: Literal["measured", "fk"] = "measured"
    """Poses that the policy is shown and that its relative poses are relative to: as the robot measures them, where
    it does; or as its joints have them in any case."""
    image_size: Size | None = None
    """Height and width that pictures are made to; as they are where it is not given."""
    resize: Resize = "pad"
    """With image_size: "pad" keeps the aspect on black, "stretch" does not."""

    @property
    def sees_poses(self) -> bool:
        """True if the responses depend on the poses of an observation."""
        relative = self.action_space == "eef" and self.action_mode != "absolute"
        return self.observation_space == "eef" or relative

    def layout(self, robot: Robot, cameras: dict[str, str]) -> RequestLayout:
        """Return the layout of requests: "state" float32 [W], "images" (by the names in `cameras`, HWC), "prompt"."""
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
        """Return the widths of the state and of a row. Raises ConfigurationError if a format does not fit the robot."""
        state = pose_rows_for(self.observation_space, self.observation_pose, robot, "observation_pose")
        rows = pose_rows_for(self.action_space, self.action_pose, robot, "action_pose")
        return robot.dim if state is None else state.width, robot.dim if rows is None else rows.width

    def chunk(self, rows: Float32, timing: Mapping[str, float]) -> ActionChunk:
        """Return a chunk of the rows [H, W] with their meaning."""
        return ActionChunk(
            actions=rows,
            space=self.action_space,
            rate=self.action_rate,
            timing=timing,
            mode=self.action_mode,
            frame=self.relative_frame,
            pose=self.action_pose,
        )
