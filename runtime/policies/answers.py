"""Settings for the meaning of a policy server's rows if the protocol leaves it open."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from runtime.core.pose_format import PoseFormat
from runtime.core.settings import Settings
from runtime.core.types import ActionMode, RelativeFrame, Space

Rate = Annotated[float, Field(ge=1, le=1000)]


class ActionFormatSettings(Settings):
    """Space, format, mode and rate of the rows of an answer."""

    action_space: Space = "joint"
    """What the rows of the answer are: joint targets, or poses."""
    action_pose: PoseFormat = PoseFormat()
    """How poses are written in the answer, where action_space is "eef"."""
    action_mode: ActionMode = "absolute"
    """What their numbers are: targets; "relative" to the observation; or "delta", each to the row before.

    Grippers are absolute in every mode. A server's own metadata key action_mode names the space, not this."""
    relative_frame: RelativeFrame = "base"
    """Axes of relative poses: those of the frame that poses are declared in, or the tool as observed."""
    action_rate: Rate | None = None
    """Rows per second of the answer [Hz]; the control rate where it is not given."""
