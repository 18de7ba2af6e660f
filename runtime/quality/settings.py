"""Bounds of the checks of recorded episodes, each with its reason."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field, ValidationError

from runtime.core import bounded_documents as bounded
from runtime.core.errors import RecordingError
from runtime.core.settings import Settings


class QualitySettings(Settings):
    """The bounds of the checks; an episode's own `[collection]` goes before `max_skew_s` and `min_length_s`."""

    # --- time ---
    timestamp_tolerance_s: float = Field(default=1e-4, gt=0.0)
    """Farthest that `timestamp` of a dataset may be from k / fps [s]; LeRobot's loaders refuse more."""
    max_gap_frames: float = Field(default=1.5, ge=1.0)
    """Longest time between the ticks of two rows, in periods of the dataset; from 2 on a row is of another moment."""
    max_skew_s: float = Field(default=0.05, gt=0.0)
    """Farthest that the streams of a row may be captured apart [s]: a camera's period at 30 Hz, and its transfer."""
    joint_age_s: float = Field(default=0.2, gt=0.0)
    """Oldest joint measurement that a row may have [s]; as `safety.joint_age_s`."""
    picture_age_s: float = Field(default=0.5, gt=0.0)
    """Oldest picture that a row may have [s]; as `safety.picture_age_s`."""
    min_length_s: float = Field(default=1.0, ge=0.0)
    """Shortest episode that is worth keeping [s]: a task takes longer."""

    # --- numbers ---
    joint_speed: float = Field(default=8.0, gt=0.0)
    """Fastest change of a joint [rad/s] where the robot is not known; twice what the fastest arms here may do."""
    speed_factor: float = Field(default=1.5, ge=1.0)
    """Fastest change of a joint of a known robot, in its velocity limits; the rest is noise of the encoder."""
    eef_speed: float = Field(default=3.0, gt=0.0)
    """Fastest change of an end effector's place [m/s]; more is a jump between solutions, not a motion."""
    quaternion_error: float = Field(default=0.01, gt=0.0)
    """Farthest that the length of a quaternion may be from 1."""

    # --- motion ---
    motion_lag_s: float = Field(default=0.2, gt=0.0)
    """Over how long motion is measured [s]: the noise of an encoder divided by it is far below `idle_speed`."""
    idle_speed: float = Field(default=0.05, gt=0.0)
    """Slower is standing [rad/s]; a person who waits stays below, the slowest approach does not."""
    idle_gripper: float = Field(default=0.05, gt=0.0)
    """Slower is standing for a gripper, in parts of its travel per second; 1 is taken where that is not known."""
    idle_head_s: float = Field(default=1.0, ge=0.0)
    """Longest standing at the start [s]: a policy that learns it learns to wait."""
    idle_tail_s: float = Field(default=2.0, ge=0.0)
    """Longest standing at the end [s]: a hand has to find the key."""
    limit_margin: float = Field(default=0.005, gt=0.0, lt=0.5)
    """How near a limit counts as at it, in parts of the joint's range."""
    saturation_s: float = Field(default=2.0, gt=0.0)
    """Longest that a joint may be commanded to a limit that it came to, while its group moves [s]; on the way home to
    a pose at a limit the real episode has 1.1 s."""
    limit_excess: float = Field(default=0.02, gt=0.0)
    """Farthest that a joint may be measured beyond its limit [rad, m]: play of a real joint."""
    tracking_error: float = Field(default=0.1, gt=0.0)
    """Nearest that a joint has to come to what was commanded, within `tracking_s` [rad, m]."""
    tracking_s: float = Field(default=0.5, gt=0.0)
    """How long a joint has for that [s]: arms follow 0.1 to 0.2 s late, so that equal times say nothing."""

    # --- pictures ---
    sampling: int = Field(default=8, ge=1, le=64)
    """Every how many pixels are looked at, along both sides: 80x60 of a picture of 640x480."""
    black: float = Field(default=10.0, ge=0.0, le=255.0)
    """Mean brightness, of 0 to 255, up to which a picture is black."""
    uniform: float = Field(default=1.5, ge=0.0)
    """Standard deviation of brightness up to which a picture shows nothing; a wall with its noise is above 2."""
    same: float = Field(default=0.04, ge=0.0)
    """Mean difference of brightness up to which two pictures are the same one. Measured behind x264 at crf 23, key
    frames aside: one picture again and again 0 to 0.03, a real camera before which nothing moves 0.05 to 0.7."""
    frozen_s: float = Field(default=1.0, gt=0.0)
    """Longest that a picture may stay the same while the robot moves [s]: what moves may be out of its sight. A camera
    that has no new picture is flagged after `picture_age_s`."""
    repeated_share: float = Field(default=0.05, ge=0.0, le=1.0)
    """Largest part of an episode's pictures that may be repeated: beyond it the camera is slower than the grid."""

    # --- the report ---
    most_flags: int = Field(default=50, ge=1)
    """Most flags of one kind and stream that a report lists; all are counted."""


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
