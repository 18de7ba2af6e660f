"""Settings of recordings: encoder and its bounds, flags, and the limit of free disk space."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Self

from pydantic import Field, field_validator, model_validator

from runtime.core.errors import ConfigurationError
from runtime.core.settings import Settings
from runtime.recording.codecs import CODECS, CodecName

Height = Annotated[int, Field(ge=32, le=4320, multiple_of=2)]
_GOP_SECONDS, _GOP = 0.5, 15


class RecordingSettings(Settings):
    """The `recording` table of a deployment file."""

    codec: CodecName = "libx264"
    """Video encoder. H.264 (libx264, h264_nvenc) plays in every browser and in every reader of datasets."""
    preset: str | None = None
    """Encoder preset, which trades processor time against size: `ultrafast` to `veryslow` for libx264 and libx265, `p1`
    to `p7` for h264_nvenc; absent: `veryfast` for libx264, `ultrafast` for libx265, `p4` for h264_nvenc."""
    crf: int | None = Field(default=None, ge=0, le=51)
    """Constant quality; smaller is better and larger on disk. Absent: 23 for libx264 and h264_nvenc, 28 for libx265."""
    gop: int | None = Field(default=None, ge=1, le=300)
    """Largest number of frames between two key frames; absent: half a second of frames, at most 15."""
    height: Height | None = None
    """Height of all videos [pixels], with the width in proportion; absent, or not below the camera's: the camera's
    height."""
    heights: dict[str, Height] = Field(default_factory=dict)
    """Height by observation key of a camera [pixels]; takes precedence over `height`."""
    queue_frames: int = Field(default=16, ge=1, le=64)
    """Largest number of images per camera that wait for the encoder; beyond it rows repeat the last image."""
    max_lag_s: float = Field(default=0.4, gt=0.0, le=10.0)
    """Longest time in which the encoder must be able to finish all waiting images [s]; beyond it new images are flagged
    as lost."""
    give_up_s: float = Field(default=5.0, ge=1.0, le=60.0)
    """Backlog after which an encoder is given up [s]: its video ends, everything else is still recorded."""
    max_skew_s: float = Field(default=0.05, gt=0.0, le=5.0)
    """Largest difference between the times of the streams of one row [s]; beyond it the row is flagged. The value of a
    `[collection]` takes precedence."""
    max_picture_age_s: float = Field(default=0.5, gt=0.0, le=60.0)
    """Greatest age of an image in a row [s]; beyond it the row is flagged and the camera named."""
    flush_period_s: float = Field(default=0.5, gt=0.0, le=1.0)
    """Longest time for which rows and events stay in memory before they are written and synced [s]."""
    min_free_bytes: int = Field(default=1 << 30, ge=0)
    """Free space below which nothing is recorded [bytes]."""
    heartbeat_timeout_s: float = Field(default=5.0, ge=1.0, le=60.0)
    """Silence of the recorder after which it is reported and no run begins [s]. A run in progress continues; it is held
    when half of the buffer for data waiting to be recorded is full."""
    drain_timeout_s: float = Field(default=10.0, gt=0.0)
    """Longest time for which the end of an episode waits for the encoders, and then for the disk [s]."""

    @field_validator("codec", mode="before")
    @classmethod
    def _refuse_what_stops(cls, codec: object) -> object:
        if codec == "libsvtav1":
            raise ConfigurationError(
                f"recording.codec = {codec!r}: as PyAV brings it, this encoder has stopped for good here, and the "
                f"camera's video with it; allowed: {', '.join(CODECS)}"
            )
        return codec

    @model_validator(mode="after")
    def _fit_the_codec(self) -> Self:
        codec = CODECS[self.codec]
        if self.preset is not None and self.preset not in codec.presets:
            raise ConfigurationError(
                f"recording.preset = {self.preset!r} with codec {self.codec!r}; allowed: {', '.join(codec.presets)}"
            )
        return self

    @property
    def chosen_preset(self) -> str:
        return CODECS[self.codec].preset if self.preset is None else self.preset

    @property
    def chosen_crf(self) -> int:
        return CODECS[self.codec].crf if self.crf is None else self.crf

    def chosen_gop(self, fps: float) -> int:
        """Return the largest number of frames from one key frame to the next, for a video of `fps` [Hz]."""
        return self.gop or max(1, min(_GOP, int(_GOP_SECONDS * fps)))

    def sizes(self, cameras: Mapping[str, tuple[int, int]]) -> dict[str, tuple[int, int]]:
        """Return the (height, width) of each video for cameras of these (height, width)."""
        return {camera: self._size(camera, *size) for camera, size in cameras.items()}

    def _size(self, camera: str, height: int, width: int) -> tuple[int, int]:
        target = self.heights.get(camera, self.height)
        if target is None or target >= height:
            return height, width
        return target, max(2, 2 * round(width * target / height / 2))
