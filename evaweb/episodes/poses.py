"""Poses of every part of the robot, row by row, for the 3D scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from evaweb.binary_frames import Stream, encode
from evaweb.episodes.curves import vectors
from evaweb.episodes.robot import drawn_robot_for
from evaweb.errors import NotFound
from runtime.core.sentences import Pattern
from runtime.recording.reader import Episode, open_episode

_ROW_EPISODE_HAS_ROWS_0 = Pattern(
    "episodes.poses.row_episode_has_rows_0",
    "row {first}: the episode has rows 0 to {frames}",
)

MOST_ROWS = 900  # of one answer: half a minute at 30 Hz


def pose_message(folder: Path, first: int) -> bytes:
    """One message of evaweb.binary_frames with stream `poses`: f4 [rows, P, 16], column-major world <- part.

    Rows `first` to at most `first` + MOST_ROWS - 1, from the measured joints. NotFound where there is no such
    robot or row; RecordingError names the file that is absent or damaged.
    """
    return pose_streams(open_episode(folder), first)


def pose_streams(episode: Episode, first: int) -> bytes:
    """The same of an episode that is open already."""
    looks = drawn_robot_for(episode.manifest)
    if not 0 <= first < max(1, episode.frames):
        raise NotFound(_ROW_EPISODE_HAS_ROWS_0(first=first, frames=episode.frames - 1))
    joints = vectors(episode.rows.slice(first, MOST_ROWS), "qpos", episode.layout.dim).T
    found = looks.poses(np.nan_to_num(joints))
    return encode({"poses": Stream(body=found)}, first=first, rows=episode.frames, fps=episode.layout.fps)
