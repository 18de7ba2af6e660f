from __future__ import annotations

import io
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from runtime.core.errors import RecordingError
from runtime.datasets.video_frames import StoredImages, VideoFrames
from tests.examples import some
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
    with VideoFrames(video) as pictures:
        assert len(pictures) == FRAMES
        assert [seen(pictures[k]) for k in range(FRAMES)] == list(range(FRAMES))


@given(order=st.lists(st.integers(0, FRAMES - 1), min_size=1, max_size=12))
@settings(max_examples=some(25))
def test_any_order_gives_the_same_pictures(video: Path, order: list[int]) -> None:
    with VideoFrames(video) as pictures:
        assert [seen(pictures[k]) for k in order] == order


def test_it_goes_back_after_the_end(video: Path) -> None:
    with VideoFrames(video) as pictures:
        assert [seen(pictures[k]) for k in (FRAMES - 1, 0, FRAMES - 1, FRAMES - 2)] == [39, 0, 39, 38]


def test_a_picture_is_rgb_and_read_only(video: Path) -> None:
    with VideoFrames(video) as pictures:
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
    with VideoFrames(path) as pictures:
        assert np.abs(pictures[0].reshape(-1, 3).mean(axis=0) - (200, 0, 0)).max() < 8


@pytest.mark.parametrize("index", [-1, FRAMES])
def test_a_frame_beyond_the_video_is_refused(video: Path, index: int) -> None:
    with VideoFrames(video) as pictures, pytest.raises(IndexError, match="frames 0 to 39"):
        pictures[index]


def test_a_file_that_is_no_video_is_named(tmp_path: Path) -> None:
    (tmp_path / "film.mp4").write_bytes(b"no video at all")
    with pytest.raises(RecordingError, match=r"film\.mp4"):
        VideoFrames(tmp_path / "film.mp4")
    with pytest.raises(RecordingError, match=r"no video .*absent\.mp4"):
        VideoFrames(tmp_path / "absent.mp4")


def damage(path: Path, frame: int) -> None:
    """Overwrite the middle of what is stored of frame number `frame`, in the order of decoding."""
    import av

    with av.open(str(path)) as container:
        packets = [packet for packet in container.demux(video=0) if packet.size]
        start, size = packets[frame].pos, packets[frame].size
    content = bytearray(path.read_bytes())
    content[start + 8 : start + size] = np.random.default_rng(1).bytes(size - 8)
    path.write_bytes(content)


def noise(path: Path, frames: int) -> None:
    import av

    draw = np.random.default_rng(0)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.options = {"g": "4", "bf": "0"}
        for _ in range(frames):
            pixels = draw.integers(0, 255, (48, 64, 3), dtype=np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        container.mux(stream.encode())


def test_a_damaged_frame_is_an_error_and_never_a_guess(tmp_path: Path) -> None:
    path = tmp_path / "film.mp4"
    noise(path, 12)
    with VideoFrames(path) as pictures:
        whole = [pictures[k] for k in range(12)]
    damage(path, 4)
    with VideoFrames(path) as pictures:
        for k in (0, 3, 8, 11):
            assert np.array_equal(pictures[k], whole[k])
        with pytest.raises(RecordingError, match=r"film\.mp4, frame 4 cannot be decoded"):
            pictures[4]
        assert np.array_equal(pictures[9], whole[9])


def test_going_backwards_decodes_a_group_a_few_times_and_not_once_a_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames, kept = 40, 12
    path = tmp_path / "film.mp4"
    write_video(path, frames, 30)
    monkeypatch.setattr("runtime.datasets.video_frames.KEPT_BYTES", kept * 48 * 64 * 3 // 2)
    with VideoFrames(path) as pictures:
        seeks = []
        seek = pictures._seek
        monkeypatch.setattr(pictures, "_seek", lambda index: (seeks.append(index), seek(index)))
        shades = [float(pictures[k].mean()) for k in reversed(range(frames))]
    assert seeks == [39, 27, 15, 3]
    with VideoFrames(path) as pictures:
        assert shades == [float(pictures[k].mean()) for k in range(frames)][::-1]


def test_a_picture_whose_header_says_that_it_is_huge_is_not_decoded(tmp_path: Path) -> None:
    small = io.BytesIO()
    Image.new("RGB", (16, 16)).save(small, "JPEG")
    content = small.getvalue()
    size = content.index(b"\xff\xc0") + 5
    huge = content[:size] + struct.pack(">HH", 5000, 6000) + content[size + 4 :]
    with pytest.raises(RecordingError, match="picture 0 is 6000 x 5000; allowed: 16777216 pixels"):
        StoredImages("cam", [{"bytes": huge}], tmp_path)[0]


def test_a_picture_of_thousands_of_scans_is_not_decoded(tmp_path: Path) -> None:
    coded = io.BytesIO()
    Image.new("RGB", (16, 16)).save(coded, "JPEG", progressive=True)
    content = coded.getvalue()
    assert StoredImages("cam", [{"bytes": content}], tmp_path)[0].shape == (16, 16, 3)
    last = content.rindex(b"\xff\xda")
    many = content[:last] + 1000 * content[last:-2] + content[-2:]
    with pytest.raises(RecordingError, match=r"picture 0 has 10\d+ scans; allowed: 64"):
        StoredImages("cam", [{"bytes": many}], tmp_path)[0]
