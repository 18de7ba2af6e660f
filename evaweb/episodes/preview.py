"""Preview of an episode for browsers: the same encoded video with the index at the front, and small images."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import simplejpeg
from numpy.typing import NDArray
from PIL import Image

from evaweb.episodes.folders import THUMBNAIL, sheet_name
from evaweb.episodes.sheets import sheet
from runtime.core.durable_files import sync_folder
from runtime.datasets.remux import remux
from runtime.datasets.video_frames import VideoFrames
from runtime.recording.files import RecordingError, disk_error, write_atomic
from runtime.recording.reader import Episode, open_episode

WIDTH = 320  # width of the thumbnail [px]
QUALITY = 82


def make_preview(journal: Path, target: Path, tell: Callable[[str], None]) -> int:
    """Write <camera>.mp4 and <camera>.sheet.jpg of every camera with images, and thumbnail.jpg, to `target`.

    The folder `target` appears only when all files are complete, and replaces an older one. `tell` receives progress
    messages.
    Returns: The number of rows.
    Raises: RecordingError, which names the file that is absent, damaged or cannot be written.
    """
    episode = open_episode(journal)
    if episode.outcome is None:
        raise RecordingError(f"{journal} has no outcome.json: it is being recorded, or wants repair")
    if not episode.frames:
        raise RecordingError(f"{journal} has no rows: there is nothing to play")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        _remove_drafts(target)
        with tempfile.TemporaryDirectory(prefix=_draft_prefix(target), dir=target.parent) as folder:
            draft = Path(folder) / "new"
            draft.mkdir()
            _fill(episode, draft, tell)
            if (
                target.is_dir()
            ):  # a folder cannot replace one that is not empty, so move the old one away first
                os.replace(target, draft.with_name("old"))
            os.replace(draft, target)
        sync_folder(target.parent)
    except OSError as error:
        raise disk_error("making a preview in", target, error) from error
    return episode.frames


def _draft_prefix(target: Path) -> str:
    return f".{target.name}."


def _remove_drafts(target: Path) -> None:
    """Remove drafts that a killed worker left behind."""
    for left in target.parent.glob(f"{_draft_prefix(target)}*"):
        shutil.rmtree(left, ignore_errors=True)


def _fill(episode: Episode, draft: Path, tell: Callable[[str], None]) -> None:
    for number, (camera, source) in enumerate(episode.videos.items(), 1):
        tell(f"camera {number} of {len(episode.videos)}")
        if not episode.frame_count(camera):
            continue  # the camera was lost before its first image
        video = draft / f"{camera}.mp4"
        remux(source, video, episode.frame_count(camera), episode.layout.fps)
        _sync(video)
        small = sheet(source, episode.frames, episode.frame_count(camera))
        write_atomic(draft / sheet_name(camera), small)
    cameras = [camera for camera in episode.videos if episode.frame_count(camera)]
    if cameras:
        middle = min(episode.frames // 2, episode.frame_count(cameras[0]) - 1)
        write_atomic(draft / THUMBNAIL, thumbnail(episode.videos[cameras[0]], middle))
    sync_folder(draft)


def thumbnail(video: Path, frame: int) -> bytes:
    """Return frame `frame` of the video as a JPEG of WIDTH pixels. Raises: RecordingError if it cannot be decoded."""
    with VideoFrames(video) as pictures:
        return jpeg_of(pictures[min(frame, len(pictures) - 1)], WIDTH)


def jpeg_of(pixels: NDArray[np.uint8], width: int) -> bytes:
    """Return an image, RGB [H, W, 3], as a JPEG `width` pixels wide, without metadata."""
    picture = Image.fromarray(pixels)
    height = max(1, round(picture.height * width / picture.width))
    small = picture.resize((width, height), Image.Resampling.LANCZOS)
    jpeg: bytes = simplejpeg.encode_jpeg(np.ascontiguousarray(small), quality=QUALITY)
    return jpeg


def _sync(path: Path) -> None:
    with path.open("rb") as file:
        os.fsync(file.fileno())
