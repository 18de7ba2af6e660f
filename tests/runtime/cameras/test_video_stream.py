from __future__ import annotations

import gc
import weakref
from pathlib import Path

import av
import numpy as np
import pytest

from runtime.cameras.base import Address, CameraError
from runtime.cameras.video_stream import Backlog, VideoStream
from runtime.standins.mjpeg_server import MjpegServer
from tests.processes import PATIENCE_S
from tests.runtime.cameras.movies import movie, number_of


def opened(path: Path) -> VideoStream:
    return VideoStream(Address(f"file:{path}", str(path)), 2.0, 2.0)


def test_a_file_is_read_to_its_end_with_the_stamp_of_each_picture(tmp_path: Path) -> None:
    feed = opened(movie(tmp_path / "film.mp4", pictures=5, rate=10))
    assert feed.rate == 10.0
    frames = [feed.read() for _ in range(6)]
    assert frames.pop() is None
    assert [number_of(frame.picture) for frame in frames if frame] == [0, 1, 2, 3, 4]
    np.testing.assert_allclose([frame.stamp for frame in frames if frame], [0.0, 0.1, 0.2, 0.3, 0.4])
    feed.close()


def test_what_is_closed_goes_with_its_decoder_and_without_the_collector(tmp_path: Path) -> None:
    feed = opened(movie(tmp_path / "film.mp4", pictures=5))
    gc.disable()
    try:
        assert feed.read() is not None
        feed.close()
        kept = weakref.ref(feed)
        del feed
        assert kept() is None
    finally:
        gc.enable()


def test_a_stream_without_a_time_of_its_own_has_no_stamps() -> None:
    server = MjpegServer()
    url = server.start()
    feed = VideoStream(Address(url, url, "mpjpeg", stamped=False), 2.0, 2.0)
    frame = feed.read()
    assert frame is not None
    assert frame.stamp is None
    feed.close()
    server.close()


@pytest.mark.parametrize("size", [4112, 4800])  # ours to refuse, and the decoder's
def test_pictures_that_are_larger_than_any_cameras_are_refused_with_their_size(
    monkeypatch: pytest.MonkeyPatch, size: int
) -> None:
    monkeypatch.setattr(
        "runtime.standins.mjpeg_server.picture", lambda *given: np.zeros((size, size, 3), np.uint8)
    )
    server = MjpegServer()
    url = server.start()
    address = Address(url, url, "mpjpeg", stamped=False)
    with pytest.raises(CameraError, match=f"its pictures are {size} x {size}; allowed: 16777216 pixels"):
        VideoStream(address, PATIENCE_S, PATIENCE_S).read()
    server.close()


def test_of_a_stream_without_stamps_that_is_read_too_slowly_what_has_waited_is_passed_over() -> None:
    server = MjpegServer(rate=1e6)  # as fast as it is taken
    url = server.start()
    feed = VideoStream(Address(url, url, "mpjpeg", stamped=False), 2.0, 2.0)
    read = 0
    while server.sent - read < 100:  # so many were sent and not shown; a busy machine takes longer for it
        assert feed.read() is not None
        read += 1
    feed.close()
    server.close()


def test_of_a_file_no_picture_is_passed_over_however_fast_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "film.avi"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mjpeg", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuvj420p"
        for _ in range(30):
            picture = av.VideoFrame.from_ndarray(np.zeros((48, 64, 3), np.uint8), format="rgb24")
            container.mux(stream.encode(picture))
        container.mux(stream.encode())
    feed = opened(path)
    read = [feed.read() for _ in range(30)]
    feed.close()
    assert None not in read


def test_a_backlog_begins_with_the_third_packet_in_a_row_and_ends_with_a_wait() -> None:
    backlog = Backlog()
    assert [backlog.should_skip(waited) for waited in (0.03, 0.0, 0.0, 0.0, 0.0, 0.03, 0.0)] == [
        False, False, False, True, True, False, False,
    ]  # fmt: skip


def test_of_a_stream_that_never_pauses_something_is_shown() -> None:
    backlog = Backlog()
    passed = [backlog.should_skip(0.0) for _ in range(1000)]
    assert passed.count(False) == 2 + 10


def test_a_file_with_sound_alone_says_what_it_has(tmp_path: Path) -> None:
    path = tmp_path / "sound.wav"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000, layout="mono")
        sound = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
        sound.sample_rate = 8000
        container.mux(stream.encode(sound))
    with pytest.raises(CameraError, match="it has no video, but audio"):
        opened(path)


@pytest.mark.parametrize("size", [0, 1, 100, 1000])
def test_a_file_that_is_cut_off_is_no_video(tmp_path: Path, size: int) -> None:
    path = movie(tmp_path / "film.mp4", pictures=12)
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(CameraError, match="not a video"):
        opened(path)
