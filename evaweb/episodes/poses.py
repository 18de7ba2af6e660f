"""Poses of the robot's parts per row, for the 3D scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from evaweb.core.binary_frames import Stream, encode
from evaweb.core.errors import NotFound
from evaweb.episodes.curves import vectors
from evaweb.episodes.manifest_robot import drawn_robot_for
from runtime.core.sentences import Pattern
from runtime.recording.reader import Episode, open_episode

_ROW_EPISODE_HAS_ROWS_0 = Pattern(
    "episodes.poses.row_episode_has_rows_0",
    "row {first}: the episode has rows 0 to {frames}",
)

MOST_ROWS = 150  # rows per response: 5 s at 30 Hz


def pose_message(folder: Path, first: int) -> bytes:
    """Return a message of evaweb.core.binary_frames with stream `poses`: f4 [rows, P, 16], column-major world <- part.

    The poses are computed from the measured joints of at most MOST_ROWS rows of the recording, beginning with row
    `first`.
    Raises: NotFound for an unknown robot or row; RecordingError, which names the absent or damaged file.
    """
    return pose_streams(open_episode(folder, videos=False), first)


def pose_streams(episode: Episode, first: int) -> bytes:
    """Return the message of `pose_message` for an open episode."""
    drawn = drawn_robot_for(episode.manifest)
    if not 0 <= first < max(1, episode.frames):
        raise NotFound(_ROW_EPISODE_HAS_ROWS_0(first=first, frames=episode.frames - 1))
    joints = vectors(episode.rows.slice(first, MOST_ROWS), "qpos", episode.layout.dim).T
    poses = drawn.poses(np.nan_to_num(joints))
    return encode({"poses": Stream(body=poses)}, first=first, rows=episode.frames, fps=episode.layout.fps)
