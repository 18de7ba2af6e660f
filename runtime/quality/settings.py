"""Bounds of the checks of recorded episodes, each with its reason."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field, ValidationError

from runtime.core import bounded_documents as bounded
from runtime.core.errors import RecordingError
from runtime.core.settings import Settings


class QualitySettings(Settings):
    """Bounds of the quality checks; an episode's own `[collection]` replaces `max_skew_s` and `min_length_s`."""

    # --- time ---
    timestamp_tolerance_s: float = Field(default=1e-4, gt=0.0)
    """Largest deviation of a dataset's `timestamp` from k / fps [s]; LeRobot's loaders refuse more."""
    max_gap_frames: float = Field(default=1.5, ge=1.0)
    """Longest time between the ticks of two rows, in periods of the dataset; from 2 on a row belongs to another
    moment."""
    max_skew_s: float = Field(default=0.05, gt=0.0)
    """Largest difference between the capture times of a row's streams [s]: a camera's period at 30 Hz, and its
    transfer."""
    joint_age_s: float = Field(default=0.2, gt=0.0)
    """Greatest age of the joint measurement of a row [s]; as `safety.joint_age_s`."""
    picture_age_s: float = Field(default=0.5, gt=0.0)
    """Greatest age of an image of a row [s]; as `safety.picture_age_s`."""
    min_length_s: float = Field(default=1.0, ge=0.0)
    """Shortest episode that is worth keeping [s]: a task takes longer."""

    # --- numbers ---
    joint_speed: float = Field(default=8.0, gt=0.0)
    """Fastest change of a joint without a known velocity limit [rad/s]: twice the limit of the fastest arms used
    here."""
    speed_factor: float = Field(default=1.5, ge=1.0)
    """Fastest change of a joint of a known robot, in multiples of its velocity limit; the margin covers noise of the
    encoder."""
    eef_speed: float = Field(default=3.0, gt=0.0)
    """Fastest change of an end effector's position [m/s]; more is a jump between solutions, not a motion."""
    quaternion_error: float = Field(default=0.01, gt=0.0)
    """Largest deviation of a quaternion's norm from 1."""

    # --- motion ---
    motion_lag_s: float = Field(default=0.2, gt=0.0)
    """Interval over which motion is measured [s]; encoder noise divided by it is far below `idle_speed`."""
    idle_speed: float = Field(default=0.05, gt=0.0)
    """Speed below which a joint is idle [rad/s]; a person who waits stays below it, the slowest approach does not."""
    idle_gripper: float = Field(default=0.05, gt=0.0)
    """Speed below which a gripper is idle, in shares of its travel per second; an unknown travel counts as 1."""
    idle_head_s: float = Field(default=1.0, ge=0.0)
    """Longest idle time at the start [s]: a policy that is trained on it learns to wait."""
    idle_tail_s: float = Field(default=2.0, ge=0.0)
    """Longest idle time at the end [s]: a hand has to find the key."""
    limit_margin: float = Field(default=0.005, gt=0.0, lt=0.5)
    """Distance within which a joint counts as at its limit, as a share of the joint's range."""
    saturation_s: float = Field(default=2.0, gt=0.0)
    """Longest time for which a joint may be commanded to a limit that it has reached, while its group moves [s]; homing
    to a pose at a limit takes 1.1 s in the real episode."""
    limit_excess: float = Field(default=0.02, gt=0.0)
    """Largest distance by which a joint may be measured beyond its limit [rad, m]: play of a real joint."""
    tracking_error: float = Field(default=0.1, gt=0.0)
    """Distance to its commanded position that a joint must reach within `tracking_s` [rad, m]."""
    tracking_s: float = Field(default=0.5, gt=0.0)
    """Time for a joint to reach its commanded position [s]: arms follow 0.1 to 0.2 s late, so that comparing equal
    times is useless."""

    # --- pictures ---
    sampling: int = Field(default=8, ge=1, le=64)
    """Distance between sampled pixels along both axes [pixels]: 8 samples 80x60 of an image of 640x480."""
    black: float = Field(default=10.0, ge=0.0, le=255.0)
    """Mean brightness, from 0 to 255, up to which an image is black."""
    uniform: float = Field(default=1.5, ge=0.0)
    """Standard deviation of brightness up to which an image shows nothing; a wall with its noise is above 2."""
    same: float = Field(default=0.04, ge=0.0)
    """Mean difference of brightness up to which two images are the same. Measured after x264 at crf 23, without key
    frames: 0 to 0.03 for one image repeated, 0.05 to 0.7 for a real camera of a motionless scene."""
    frozen_s: float = Field(default=1.0, gt=0.0)
    """Longest time for which an image may stay the same while the robot moves [s]: the moving part may be out of view.
    A camera without a new image is flagged after `picture_age_s`."""
    repeated_share: float = Field(default=0.05, ge=0.0, le=1.0)
    """Largest share of an episode's images that may be repeated: beyond it the camera is slower than the grid."""

    # --- the report ---
    most_flags: int = Field(default=50, ge=1)
    """Largest number of flags of one kind and stream that a report lists; all are counted."""


def read_settings(path: Path) -> QualitySettings:
    """Read bounds from a TOML file with keys of QualitySettings. Raises RecordingError with the file and key."""
    try:
        content = bounded.load_toml(path, str(path))
    except FileNotFoundError:
        raise RecordingError(f"there is no file {path} with settings") from None
    except bounded.UnreadableDocument as error:
        raise RecordingError(str(error)) from error
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error}") from error
    try:
        return QualitySettings.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        raise RecordingError(
            f"{path}: {key} = {first['input']!r:.80}: {first['msg']}; there are {sorted(QualitySettings.model_fields)}"
        ) from None
