"""How episodes are written: the encoder, the bounds of its queue, and when the disk counts as full."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from runtime.section import Section


class RecordingSettings(Section):
    """The `recording` table of a deployment file."""

    codec: Literal["libx264"] = "libx264"
    """Video encoder; H.264 plays in every browser and in every reader of datasets."""
    preset: Literal["ultrafast", "superfast", "veryfast", "faster", "fast", "medium"] = "veryfast"
    """x264's trade of processor time against size."""
    crf: int = Field(default=23, ge=0, le=40)
    """Constant rate factor: smaller is better and larger on disk."""
    gop: int = Field(default=15, ge=1, le=15)
    """Most frames between two key frames; half a second is a second bound."""
    queue_frames: int = Field(default=8, ge=1, le=64)
    """Most pictures per camera that wait for the encoder; beyond it rows repeat the last picture."""
    flush_period_s: float = Field(default=0.5, gt=0.0, le=1.0)
    """Longest time that rows and events stay in memory before they are written and synced [s]."""
    min_free_bytes: int = Field(default=1 << 30, ge=0)
    """Free space below which nothing is recorded [bytes]."""
    drain_timeout_s: float = Field(default=10.0, gt=0.0)
    """Longest time that the end of an episode waits for encoders and the disk [s]."""
