from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest
import simplejpeg

from runtime.core.picture_bounds import MOST_PIXELS, TooLargeError, open_video, require_size


def filmed(path: Path, width: int, height: int) -> Path:
    """A video of one picture."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"preset": "ultrafast"})
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        frame = av.VideoFrame.from_ndarray(np.zeros((height, width, 3), np.uint8), format="rgb24")
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def test_a_video_is_read_up_to_the_bound_and_refused_with_its_size_beyond(tmp_path: Path) -> None:
    with open_video(
        filmed(tmp_path / "film.mp4", 4112, 4080)
    ) as container:  # that decoders round up beyond it
        assert next(container.decode(video=0)).width == 4112
    with pytest.raises(TooLargeError, match=f"4112 x 4096; allowed: {MOST_PIXELS} pixels"):
        open_video(filmed(tmp_path / "large.mp4", 4112, 4096))


def test_where_the_file_does_not_say_it_the_decoder_refuses(tmp_path: Path) -> None:
    path = tmp_path / "large.mjpeg"
    jpeg = simplejpeg.encode_jpeg(np.zeros((4600, 4600, 1), np.uint8), colorspace="GRAY")
    path.write_bytes(3 * jpeg)
    with open_video(path) as container, pytest.raises(av.FFmpegError):
        next(container.decode(video=0))


def test_whose_it_is_is_said() -> None:
    require_size(4096, 4096)
    with pytest.raises(TooLargeError, match="picture 3 is 65500 x 65500; allowed"):
        require_size(65500, 65500, "picture 3 is")
