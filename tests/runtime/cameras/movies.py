"""Small videos and the waiting for live cameras that several tests need."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import av
import numpy as np

RED, BLUE = (220, 0, 0), (0, 0, 220)


def movie(path: Path, pictures: int = 10, rate: int = 10, size: tuple[int, int] = (64, 48)) -> Path:
    """A video whose picture k is gray of brightness 20 * (k + 1), without loss."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=rate, options={"qp": "0", "preset": "ultrafast"})
        stream.width, stream.height = size
        stream.pix_fmt = "yuv420p"
        for number in range(pictures):
            gray = np.full((size[1], size[0], 3), 20 * (number + 1), np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(gray, format="rgb24")))
        container.mux(stream.encode())
    return path


def number_of(picture: np.ndarray) -> int:
    """Which picture of a `movie` this is."""
    return round(float(picture.mean()) / 20) - 1


def until(reached: Callable[[], object], seconds: float = 10.0) -> None:
    """Wait for what another thread does; fails where it does not happen."""
    deadline = time.monotonic() + seconds
    while not reached():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.005)
