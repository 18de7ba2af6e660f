from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from runtime.datasets.pictures import Pictures
from runtime.errors import RecordingError
from tests.runtime.datasets.small import seen, write_video

FRAMES = 40


@pytest.fixture(
    scope="module", params=[(250, 3), (7, 2), (1, 0)], ids=["one group", "short groups", "keys only"]
)
def video(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("video") / "film.mp4"
    write_video(path, FRAMES, 30, gop=request.param[0], b_frames=request.param[1])
    return path


def test_frames_read_in_order_are_the_frames_written(video: Path) -> None:
    with Pictures(video) as pictures:
        assert len(pictures) == FRAMES
        assert [seen(pictures[k]) for k in range(FRAMES)] == list(range(FRAMES))


@given(order=st.lists(st.integers(0, FRAMES - 1), min_size=1, max_size=12))
@settings(max_examples=25, deadline=None)
def test_any_order_gives_the_same_pictures(video: Path, order: list[int]) -> None:
    with Pictures(video) as pictures:
        assert [seen(pictures[k]) for k in order] == order


def test_it_goes_back_after_the_end(video: Path) -> None:
    with Pictures(video) as pictures:
        assert [seen(pictures[k]) for k in (FRAMES - 1, 0, FRAMES - 1, FRAMES - 2)] == [39, 0, 39, 38]


def test_a_picture_is_rgb_and_read_only(video: Path) -> None:
    with Pictures(video) as pictures:
        first = pictures[0]
        assert (first.dtype, first.shape) == (np.uint8, (48, 64, 3))
        with pytest.raises(ValueError, match="read-only"):
            first[0, 0, 0] = 1


def test_colours_come_as_rgb(tmp_path: Path) -> None:
    import av

    path = tmp_path / "red.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        red = np.zeros((48, 64, 3), np.uint8)
        red[..., 0] = 200
        container.mux(stream.encode(av.VideoFrame.from_ndarray(red, format="rgb24")))
        container.mux(stream.encode())
    with Pictures(path) as pictures:
        assert np.abs(pictures[0].reshape(-1, 3).mean(axis=0) - (200, 0, 0)).max() < 8


@pytest.mark.parametrize("index", [-1, FRAMES])
def test_a_frame_beyond_the_video_is_refused(video: Path, index: int) -> None:
    with Pictures(video) as pictures, pytest.raises(IndexError, match="frames 0 to 39"):
        pictures[index]


def test_a_file_that_is_no_video_is_named(tmp_path: Path) -> None:
    (tmp_path / "film.mp4").write_bytes(b"no video at all")
    with pytest.raises(RecordingError, match=r"film\.mp4"):
        Pictures(tmp_path / "film.mp4")
    with pytest.raises(RecordingError, match=r"no video .*absent\.mp4"):
        Pictures(tmp_path / "absent.mp4")
