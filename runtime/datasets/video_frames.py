"""Images of one episode and camera by frame number, which is exact with any B-frames and groups of pictures."""

from __future__ import annotations

import io
from abc import ABC, abstractmethod
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from runtime.core.errors import RecordingError
from runtime.core.picture_bounds import DAMAGED, TooLargeError, open_video, require_scans, require_size
from runtime.core.types import UInt8

if TYPE_CHECKING:
    import av
    from numpy.typing import NDArray
    from PIL import Image


KEPT_BYTES = (
    16 << 20
)  # bytes of decoded frames cached per video, so that reading backwards decodes a group of pictures once


class ImageSequence(ABC):
    """Images of one camera and episode: image k is RGB uint8 [H, W, 3], read-only. Not thread-safe."""

    @abstractmethod
    def __len__(self) -> int:
        """Return the number of images."""

    @abstractmethod
    def __getitem__(self, index: int) -> UInt8:
        """Return image `index`.

        Raises:
            IndexError: There is no such image.
            RecordingError: The image cannot be decoded.
        """

    @abstractmethod
    def close(self) -> None:
        """Release the file; safe to call twice."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


@dataclass(frozen=True, slots=True)
class VideoSegment:
    """Part of a video that is one episode: frame k at `start` + k / `fps` [s]."""

    start: float
    frames: int
    fps: float

    @property
    def end(self) -> float:
        return self.start + self.frames / self.fps


class VideoFrames(ImageSequence):
    """Frames of a video, or of a segment of it.

    Frames are numbered in order of presentation by a scan of the packets, never by rounded times. Reading in order
    decodes each frame once; any other order seeks to the key frame before the requested frame and decodes from there.
    The newest decoded frames are cached. Raises: RecordingError, which names the file.
    """

    def __init__(self, path: Path, stretch: VideoSegment | None = None) -> None:
        import av

        self._path = path
        self._stretch = stretch
        self._errors = (av.FFmpegError, ValueError)
        if not path.is_file():
            raise RecordingError(f"there is no video {path}")
        try:
            self._container = open_video(path)
        except self._errors as error:
            raise RecordingError(f"{path} cannot be opened as a video: {error}") from error
        try:
            self._scan()
        except BaseException:
            self._container.close()
            raise
        self._frames: Iterator[av.VideoFrame] = iter(())
        self._upcoming: int | None = None  # frame that `_frames` yields next; None: seek first
        self._newest: tuple[int, UInt8] | None = None
        self._kept: dict[int, av.VideoFrame] = {}  # cached frames, in the order of decoding

    def _scan(self) -> None:
        if not self._container.streams.video:
            raise RecordingError(f"{self._path} has no video stream")
        self._stream: Any = self._container.streams.video[0]
        times, keys = [], []
        try:
            for packet in self._packets():
                times.append(packet.pts)
                if packet.is_keyframe:
                    keys.append(packet.pts)
        except self._errors as error:
            raise RecordingError(f"{self._path} is broken after {len(times)} frames: {error}") from error
        self._times, self._keys = sorted(times), sorted(keys)
        if self._stretch is not None:
            self._cut(self._stretch)
        if not self._times:
            raise RecordingError(f"{self._path} has no frames")
        if not self._keys or self._keys[0] > self._times[0]:
            raise RecordingError(f"{self._path} does not start with a key frame")

    def _packets(self) -> Iterator[Any]:
        """Yield the packets whose frames are numbered.

        These are all packets of the file or, for a segment, the packets from the last key frame before the segment to
        the segment's end.
        """
        end = None
        if self._stretch is not None:
            self._container.seek(int(self._stretch.start / self._stream.time_base), stream=self._stream)
            end = self._stretch.end / self._stream.time_base
        for packet in self._container.demux(self._stream):
            if packet.pts is None or packet.is_discard:
                continue
            if end is not None and packet.dts is not None and packet.dts > end:
                return
            yield packet

    def _cut(self, stretch: VideoSegment) -> None:
        half, base = 0.5 / stretch.fps, float(self._stream.time_base)
        first, last = stretch.start - half, stretch.end - half
        self._times = [time for time in self._times if first <= time * base < last]
        where = f"{self._path}, {stretch.start:.3f} to {stretch.end:.3f} s"
        if len(self._times) != stretch.frames:
            raise RecordingError(f"{where} has {len(self._times)} frames for {stretch.frames} rows")
        for number, time in enumerate(self._times):
            off = abs(time * base - stretch.start - number / stretch.fps)
            if off >= half:
                raise RecordingError(f"{where}: frame {number} is {off:.4f} s off its row")

    @property
    def times(self) -> list[float]:
        """Presentation times of the frames in the file [s]."""
        base = float(self._stream.time_base)
        return [time * base for time in self._times]

    @property
    def stamps(self) -> list[int]:
        """Presentation times of the frames, as time stamps in the file."""
        return list(self._times)

    def coded(self) -> Iterator[bytes]:
        """Yield the frames' packets as stored, in coded order; reading an image afterwards requires a seek."""
        times = set(self._times)
        self._upcoming = None
        try:
            self._container.seek(self._key_before(0), stream=self._stream)
            for packet in self._packets():
                if packet.pts in times:
                    yield bytes(packet)
        except self._errors as error:
            raise RecordingError(f"{self._path} cannot be read: {error}") from error

    @property
    def size(self) -> tuple[int, int]:
        """Height and width, as the stream declares them."""
        return self._stream.height, self._stream.width

    @property
    def is_deep(self) -> bool:
        """True if the video is depth: one component of more than 8 bits."""
        pixel_format = self._stream.codec_context.format
        return pixel_format is not None and [part.bits > 8 for part in pixel_format.components] == [True]

    def __len__(self) -> int:
        return len(self._times)

    def __getitem__(self, index: int) -> UInt8:
        if not 0 <= index < len(self._times):
            raise IndexError(f"{self._path} has frames 0 to {len(self) - 1}, asked for {index}")
        if self._newest is None or self._newest[0] != index:
            self._newest = (index, self._picture(index))
        return self._newest[1]

    def _picture(self, index: int) -> UInt8:
        try:
            frame = self._kept[index] if index in self._kept else self._decode(index)
            if frame.is_corrupt:
                raise ValueError("its data are damaged")
            picture = np.asarray(frame.to_ndarray(format="rgb24"), dtype=np.uint8)
        except self._errors as error:
            self._upcoming = None
            raise RecordingError(f"{self._path}, frame {index} cannot be decoded: {error}") from error
        picture.flags.writeable = False
        return picture

    def _decode(self, index: int) -> av.VideoFrame:
        if not self._reachable(index):
            self._seek(index)
        for frame in self._frames:
            if frame.pts is None:
                continue
            number = bisect_left(self._times, frame.pts)
            if number < len(self._times) and self._times[number] == frame.pts:
                self._store(number, frame)
                self._upcoming = number + 1
            if frame.pts == self._times[index]:
                return frame
            if frame.pts > self._times[index]:
                break
        self._upcoming = None
        raise RecordingError(f"{self._path}, frame {index} is listed but does not decode")

    def _store(self, number: int, frame: av.VideoFrame) -> None:
        self._kept.pop(number, None)
        self._kept[number] = frame
        room = max(2, KEPT_BYTES // (frame.width * frame.height * 3 // 2))
        while len(self._kept) > room:
            del self._kept[next(iter(self._kept))]

    def _reachable(self, index: int) -> bool:
        """Return True if frame `index` is ahead with no key frame in between, so that decoding can continue without a
        seek.
        """
        if self._upcoming is None or index < self._upcoming:
            return False
        return index == self._upcoming or self._key_before(index) <= self._times[self._upcoming]

    def _key_before(self, index: int) -> int:
        key: int = self._keys[bisect_right(self._keys, self._times[index]) - 1]
        return key

    def _seek(self, index: int) -> None:
        key = self._key_before(index)
        self._container.seek(key, stream=self._stream, backward=True, any_frame=False)
        self._frames = self._container.decode(self._stream)
        self._upcoming = bisect_left(self._times, key)

    def close(self) -> None:
        self._frames = iter(())
        self._upcoming = None
        self._kept.clear()
        self._container.close()


def stored_row(found: object) -> Mapping[str, Any] | None:
    """Return a row of an image column as a map with "bytes" and "path"; None if it is empty.

    Some writers store only the bytes or the path.
    """
    if isinstance(found, Mapping):
        return found
    if isinstance(found, bytes):
        return {"bytes": found, "path": None}
    return {"bytes": None, "path": found} if isinstance(found, str) else None


def to_rgb(image: Image.Image) -> UInt8:
    """Convert an open image to RGB uint8 [H, W, 3]; depth becomes grey, with its most distant point white."""
    depth = _depth(image)
    if depth is None:
        return np.array(image.convert("RGB"), dtype=np.uint8)
    finite_depth = np.where(np.isfinite(depth), depth, 0.0)
    grey = np.clip(finite_depth * (255.0 / max(finite_depth.max(), 1e-9)), 0, 255).round().astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def _depth(image: Image.Image) -> NDArray[np.float64] | None:
    if image.mode == "F":
        return np.asarray(image, np.float64)
    return np.asarray(image, np.float64) / 65535 if image.mode.startswith("I") else None


class StoredImages(ImageSequence):
    """Images of an image column: encoded as PNG, JPEG or TIFF in the rows, or in files that the rows name.

    Depth becomes grey: the most distant point of an image is white, unknown (0) is black.
    """

    def __init__(self, name: str, rows: Sequence[object], root: Path) -> None:
        self._name = name
        self._rows = rows
        self._root = root

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, index: int) -> UInt8:
        if not 0 <= index < len(self._rows):
            raise IndexError(f"{self._name} has pictures 0 to {len(self) - 1}, asked for {index}")
        with self._opened(index) as image:
            picture = to_rgb(image)
        picture.flags.writeable = False
        return picture

    def size(self, index: int) -> tuple[int, int]:
        """Return height and width of image `index` from its header. Raises: RecordingError."""
        with self._opened(index) as image:
            return image.height, image.width

    def depth(self, index: int) -> NDArray[np.float64] | None:
        """Return image `index` as float64 [H, W] if it is a depth image, else None.

        Depth of 16 bits is divided by 65535, floats are unchanged.
        """
        with self._opened(index) as image:
            return _depth(image)

    def is_missing(self, index: int) -> bool:
        """Return True if nothing is stored for image `index`."""
        row = stored_row(self._rows[index])
        return row is None or (row.get("bytes") is None and not row.get("path"))

    def row(self, index: int) -> dict[str, Any] | None:
        """Return the stored row of image `index`, with its file's content as "bytes"; None if nothing is stored."""
        if self.is_missing(index):
            return None
        path = (stored_row(self._rows[index]) or {}).get("path")
        return {"bytes": self._coded(index), "path": Path(str(path or f"{index}.png")).name}

    @contextmanager
    def _opened(self, index: int) -> Iterator[Image.Image]:
        from PIL import Image

        try:
            coded = self._coded(index)
            require_scans(coded, f"{self._name}, picture {index} has")
            with Image.open(io.BytesIO(coded)) as image:
                require_size(*image.size, f"{self._name}, picture {index} is")
                yield image
        except TooLargeError as error:
            raise RecordingError(str(error)) from None
        except (*DAMAGED, Image.DecompressionBombError) as error:
            raise RecordingError(f"{self._name}, picture {index} cannot be decoded: {error}") from error

    def _coded(self, index: int) -> bytes:
        row = stored_row(self._rows[index])
        if row is None or self.is_missing(index):
            raise RecordingError(f"{self._name}, picture {index} is missing")
        if row.get("bytes") is not None:
            return bytes(row["bytes"])
        path = self._root / str(row["path"])
        if not path.resolve().is_relative_to(self._root.resolve()):
            raise RecordingError(f"{self._name}, picture {index} lies outside of the dataset: {row['path']}")
        return path.read_bytes()

    def close(self) -> None:
        """Do nothing, because no file is open."""
