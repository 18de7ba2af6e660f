"""The pictures of one video file by frame number, exact whatever its B-frames and groups of pictures."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np

from runtime.errors import RecordingError
from runtime.types import UInt8

if TYPE_CHECKING:
    import av


class Pictures:
    """Frame k of a video as RGB uint8 [H, W, 3], read-only.

    Frames are numbered in order of presentation from a scan of the packets, never from rounded times. Reading
    in order decodes each frame once; any other order seeks to the key frame before the wanted one and decodes
    forward from there. Not safe to share between threads. Raises RecordingError, naming the file.
    """

    def __init__(self, path: Path) -> None:
        import av

        self._path = path
        self._errors = (av.FFmpegError, ValueError)
        if not path.is_file():
            raise RecordingError(f"there is no video {path}")
        try:
            self._container = av.open(str(path))
        except self._errors as error:
            raise RecordingError(f"{path} cannot be opened as a video: {error}") from error
        try:
            self._scan()
        except BaseException:
            self._container.close()
            raise
        self._frames: Iterator[av.VideoFrame] = iter(())
        self._upcoming: int | None = None  # the frame that `_frames` yields next; None: a seek is due
        self._newest: tuple[int, UInt8] | None = None

    def _scan(self) -> None:
        if not self._container.streams.video:
            raise RecordingError(f"{self._path} has no video stream")
        self._stream: Any = self._container.streams.video[0]
        times, keys = [], []
        try:
            for packet in self._container.demux(self._stream):
                if packet.pts is None or packet.is_discard:
                    continue
                times.append(packet.pts)
                if packet.is_keyframe:
                    keys.append(packet.pts)
        except self._errors as error:
            raise RecordingError(f"{self._path} is broken after {len(times)} frames: {error}") from error
        self._times, self._keys = sorted(times), sorted(keys)
        if not self._keys or self._keys[0] != self._times[0]:
            raise RecordingError(f"{self._path} does not start with a key frame")

    def __len__(self) -> int:
        return len(self._times)

    def __getitem__(self, index: int) -> UInt8:
        if not 0 <= index < len(self._times):
            raise IndexError(f"{self._path} has frames 0 to {len(self) - 1}, asked for {index}")
        if self._newest is None or self._newest[0] != index:
            self._newest = (index, self._decode(index))
        return self._newest[1]

    def _decode(self, index: int) -> UInt8:
        try:
            if not self._reachable(index):
                self._seek(index)
            for frame in self._frames:
                if frame.pts is None or frame.pts < self._times[index]:
                    continue
                if frame.pts != self._times[index]:
                    break
                self._upcoming = index + 1
                picture = np.asarray(frame.to_ndarray(format="rgb24"), dtype=np.uint8)
                picture.flags.writeable = False
                return picture
        except self._errors as error:
            self._upcoming = None
            raise RecordingError(f"{self._path}, frame {index} cannot be decoded: {error}") from error
        self._upcoming = None
        raise RecordingError(f"{self._path}, frame {index} is listed but does not decode")

    def _reachable(self, index: int) -> bool:
        """Whether decoding on is the way: the frame lies ahead and no key frame lies between."""
        if self._upcoming is None or index < self._upcoming:
            return False
        return index == self._upcoming or self._key_before(index) <= self._times[self._upcoming]

    def _key_before(self, index: int) -> int:
        return self._keys[bisect_right(self._keys, self._times[index]) - 1]

    def _seek(self, index: int) -> None:
        key = self._key_before(index)
        self._container.seek(key, stream=self._stream, backward=True, any_frame=False)
        self._frames = self._container.decode(self._stream)
        self._upcoming = bisect_left(self._times, key)

    def close(self) -> None:
        """Release the file; safe to call twice."""
        self._frames = iter(())
        self._upcoming = None
        self._container.close()

    def __enter__(self) -> Pictures:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
