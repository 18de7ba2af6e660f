"""Brightness of every picture of a video at low cost: decoded in order, sampled at every n-th pixel."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import av
import numpy as np

from runtime.core.errors import RecordingError
from runtime.core.picture_bounds import open_video
from runtime.core.types import Float32
from runtime.datasets.video_frames import ImageSequence, VideoSegment

# Formats whose first plane is brightness with 8 bits per pixel; others are converted, which takes twice as long.
_PLANAR = frozenset({"yuv420p", "yuvj420p", "yuv422p", "yuvj422p", "yuv444p", "yuvj444p", "nv12", "gray"})
_FULL = frozenset({"yuvj420p", "yuvj422p", "yuvj444p", "gray"})
_JPEG = 2  # AVCOL_RANGE_JPEG


@dataclass(frozen=True, slots=True, eq=False)
class LumaFrame:
    """Brightness of one picture.

    `luma` is float32 [h, w] from 0 to 255, `height` and `width` are the full size, `key` is True for a key frame.
    """

    luma: Float32
    height: int
    width: int
    key: bool
    time: float | None  # [s] since the episode's first picture is due; None if pictures have no times


class FrameStream(Protocol):
    """Pictures of one camera in an episode, each once and in order."""

    def __iter__(self) -> Iterator[LumaFrame]:
        """Yield the pictures. Raises RecordingError at a picture that cannot be decoded."""
        ...

    def close(self) -> None:
        """Release the file. Safe to call twice."""
        ...


class VideoFrameStream:
    """Pictures of a video, or of a segment of one."""

    def __init__(self, path: Path, sampling: int, stretch: VideoSegment | None = None) -> None:
        if not path.is_file():
            raise RecordingError(f"there is no video {path}")
        self._path = path
        self._sampling = sampling
        self._stretch = stretch
        try:
            self._container = open_video(path)
        except (av.FFmpegError, ValueError) as error:
            raise RecordingError(f"{path} cannot be opened as a video: {error}") from error
        if not self._container.streams.video:
            self.close()
            raise RecordingError(f"{path} has no video stream")

    def __iter__(self) -> Iterator[LumaFrame]:
        stream = self._container.streams.video[0]
        stream.thread_type = "NONE"  # checks may run on a machine that controls a robot
        start, end = 0.0, float("inf")
        number = 0
        try:
            if self._stretch is not None:
                half = 0.5 / self._stretch.fps
                start, end = self._stretch.start, self._stretch.end - half
                ticks = max(0.0, start) / float(stream.time_base or 1)
                self._container.seek(int(ticks), stream=stream)
            for frame in self._container.decode(stream):
                if self._stretch is not None and frame.time is not None and frame.time < start - half:
                    continue
                if frame.time is not None and frame.time >= end:
                    return
                if frame.is_corrupt:
                    raise ValueError("its data are damaged")
                yield self._shot(frame, None if frame.time is None else float(frame.time) - start)
                number += 1
        except (av.FFmpegError, ValueError) as error:
            raise RecordingError(f"{self._path}, frame {number} cannot be decoded: {error}") from error

    def _shot(self, frame: Any, time: float | None) -> LumaFrame:
        kind = frame.format.name
        full = kind in _FULL or frame.color_range == _JPEG
        if kind not in _PLANAR:
            frame, full = frame.reformat(format="gray", dst_color_range="JPEG"), True
        plane = frame.planes[0]
        rows = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)
        sampled = rows[: frame.height : self._sampling, : frame.width : self._sampling].astype(np.float32)
        luma = sampled if full else np.clip((sampled - 16.0) * (255.0 / 219.0), 0.0, 255.0)
        return LumaFrame(luma, frame.height, frame.width, bool(frame.key_frame), time)

    def close(self) -> None:
        self._container.close()


class StoredFrameStream:
    """Pictures that are stored individually; each counts as a key frame."""

    def __init__(self, pictures: ImageSequence, sampling: int) -> None:
        self._pictures = pictures
        self._sampling = sampling

    def __iter__(self) -> Iterator[LumaFrame]:
        for number in range(len(self._pictures)):
            picture = self._pictures[number]
            height, width = picture.shape[:2]
            sampled = picture[:: self._sampling, :: self._sampling].astype(np.float32)
            luma = (sampled @ np.array([0.299, 0.587, 0.114], np.float32)).astype(np.float32)
            yield LumaFrame(luma, height, width, True, None)

    def close(self) -> None:
        self._pictures.close()
