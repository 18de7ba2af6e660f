"""Assignment of a LeRobot dataset's columns to their meaning; foreign datasets use names of their own."""

from __future__ import annotations

from typing import Any

from pydantic import Field, field_validator

from runtime.core.settings import Settings


class ColumnMapping(Settings):
    """Column names of one dataset; an empty string means that the dataset does not have the column."""

    state: str = "observation.state"
    """Measured joint positions, [D] in group order."""
    eef: str | None = None
    """Measured end-effector poses, 8 numbers per arm."""
    velocity: str | None = None
    """Measured joint velocities, [D]."""
    effort: str | None = None
    """Measured joint efforts, [D]."""
    action: str | None = "action"
    """Commanded joint positions, [D]."""
    action_eef: str | None = None
    """Commanded end-effector poses, 8 numbers per arm."""
    videos: dict[str, str] | None = None
    """Video key by camera key; absent: `observation.images.<camera key>` for every camera."""
    capture_time: dict[str, str] = Field(default_factory=dict)
    """Column of capture times [s] by stream ("joints", "eef", or a camera key)."""

    @field_validator("eef", "velocity", "effort", "action", "action_eef", mode="before")
    @classmethod
    def _empty_is_absent(cls, value: Any) -> Any:
        return None if value == "" else value


def video_key(camera: str) -> str:
    """Return the video key of a camera by LeRobot's convention."""
    return f"observation.images.{camera}"
