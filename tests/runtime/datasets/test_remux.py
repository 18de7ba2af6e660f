from __future__ import annotations

import io
from fractions import Fraction
from pathlib import Path

import av
import pytest

from runtime.core.errors import RecordingError
from runtime.datasets.remux import VideoFacts, cut, remux
from runtime.datasets.video_frames import VideoFrames
from tests.runtime.datasets.small import record, seen, write_video


@pytest.mark.parametrize("fps", [30.0, 29.97, 12.5, 24.0])
def test_frame_k_is_shown_at_k_over_fps(tmp_path: Path, fps: float) -> None:
    write_video(tmp_path / "film.mp4", 20, 10, b_frames=0)
    facts = remux(tmp_path / "film.mp4", tmp_path / "out.mp4", 20, fps)
    assert facts == VideoFacts(48, 64, "h264", "yuv420p")
    with av.open(str(tmp_path / "out.mp4")) as container:
        times = [frame.time for frame in container.decode(video=0)]
    assert times == pytest.approx([k / fps for k in range(20)], abs=1e-5)


def test_the_video_is_cut_at_the_rows(tmp_path: Path) -> None:
    write_video(tmp_path / "film.mp4", 20, 30, b_frames=0)
    remux(tmp_path / "film.mp4", tmp_path / "out.mp4", 13, 30)
    with VideoFrames(tmp_path / "out.mp4") as pictures:
        assert [seen(pictures[k]) for k in range(len(pictures))] == list(range(13))


def test_the_index_comes_first(tmp_path: Path) -> None:
    write_video(tmp_path / "film.mp4", 20, 30, b_frames=0)
    remux(tmp_path / "film.mp4", tmp_path / "out.mp4", 20, 30)
    data = (tmp_path / "out.mp4").read_bytes()
    assert 0 < data.find(b"moov") < data.find(b"mdat")


def test_it_reads_the_fragments_of_the_recorder(tmp_path: Path) -> None:
    episode = record(tmp_path, frames=40)
    remux(episode / "cam_high.mp4", tmp_path / "out.mp4", 40, 30)
    with VideoFrames(tmp_path / "out.mp4") as pictures:
        assert [seen(pictures[k]) for k in (39, 0, 20)] == [39, 0, 20]


def test_a_video_shorter_than_the_rows_is_refused(tmp_path: Path) -> None:
    write_video(tmp_path / "film.mp4", 20, 30, b_frames=0)
    with pytest.raises(RecordingError, match="20 frames for 21 rows"):
        remux(tmp_path / "film.mp4", tmp_path / "out.mp4", 21, 30)


def test_b_frames_are_refused(tmp_path: Path) -> None:
    write_video(tmp_path / "film.mp4", 20, 30, b_frames=2)
    with pytest.raises(RecordingError, match="B-frames at frame"):
        remux(tmp_path / "film.mp4", tmp_path / "out.mp4", 20, 30)


def test_a_file_that_is_no_video_is_named(tmp_path: Path) -> None:
    (tmp_path / "film.mp4").write_bytes(b"nothing")
    with pytest.raises(RecordingError, match=r"film\.mp4 cannot be copied"):
        remux(tmp_path / "film.mp4", tmp_path / "out.mp4", 1, 30)


def test_fractions_of_a_rate_stay_exact(tmp_path: Path) -> None:
    write_video(tmp_path / "film.mp4", 30, 30, b_frames=0)
    remux(tmp_path / "film.mp4", tmp_path / "out.mp4", 30, 30000 / 1001)
    with av.open(str(tmp_path / "out.mp4")) as container:
        stream = container.streams.video[0]
        assert stream.time_base is not None
        times = [p.pts * stream.time_base for p in container.demux(stream) if p.pts is not None and p.size]
    assert times == [Fraction(1001 * k, 30000) for k in range(30)]


def test_a_clip_begins_with_the_key_frame_before_and_ends_where_it_is_said(tmp_path: Path) -> None:
    write_video(tmp_path / "film.mp4", 40, 10, gop=15, b_frames=0)
    for begin, end, first, last in (
        (0.0, 0.5, 0, 4),
        (1.5, 2.0, 15, 19),
        (2.9, 3.15, 15, 31),
        (3.4, 99.0, 30, 39),
    ):
        target = io.BytesIO()
        assert cut(tmp_path / "film.mp4", target, begin, end) == pytest.approx(first / 10)
        (tmp_path / "clip.mp4").write_bytes(target.getvalue())
        with VideoFrames(tmp_path / "clip.mp4") as pictures:
            assert [seen(pictures[k]) for k in range(len(pictures))] == list(range(first, last + 1))
    with pytest.raises(RecordingError, match="no pictures from"):
        cut(tmp_path / "film.mp4", io.BytesIO(), 0.0, 0.0)
