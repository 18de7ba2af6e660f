from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest

from runtime.core.errors import RecordingError
from runtime.datasets.entries import Span
from runtime.datasets.reader import open_dataset
from runtime.datasets.video_frames import VideoFrames, VideoSegment
from runtime.datasets.video_segments import NotCopyableError, copy_segment, encode_segment
from tests.runtime.datasets.foreign import Plan, shown, write
from tests.runtime.datasets.small import seen, write_video

PLANS = {
    "one group each": Plan(),
    "without B-frames": Plan(b_frames=0),
    "short groups": Plan(gop=3, b_frames=2),
    "key frames alone": Plan(gop=1, b_frames=0),
    "fractional rate": Plan(fps=30000 / 1001),
}


def coded(path: Path) -> list[bytes]:
    with av.open(str(path)) as container:
        return [bytes(packet) for packet in container.demux(video=0) if packet.size]


def index_first(path: Path) -> bool:
    content = path.read_bytes()
    return 0 <= content.find(b"moov") < content.find(b"mdat")


@pytest.mark.parametrize("plan", PLANS.values(), ids=list(PLANS))
def test_each_episode_of_a_common_video_becomes_one_of_its_own(tmp_path: Path, plan: Plan) -> None:
    write(tmp_path / "set", plan)
    dataset, parts = open_dataset(tmp_path / "set"), []
    for index, length in enumerate(plan.lengths):
        span, target = dataset.episode(index).videos["cam_high"], tmp_path / f"{index}.mp4"
        copy_segment(span, target, length, plan.fps)
        assert index_first(target)
        with VideoFrames(target) as pictures:
            assert len(pictures) == length
            assert np.allclose(pictures.times, np.arange(length) / plan.fps, atol=1e-4)
            assert [seen(pictures[k]) for k in range(length)] == [shown(index, k) for k in range(length)]
        assert span.start is not None
        with (
            VideoFrames(target) as one,
            VideoFrames(span.path, VideoSegment(span.start, length, plan.fps)) as other,
        ):
            assert all(np.array_equal(one[k], other[k]) for k in range(length))
        parts += coded(target)
    assert parts == coded(dataset.episode(0).videos["cam_high"].path)


def test_a_file_that_is_ready_is_copied_as_it_is(tmp_path: Path) -> None:
    write_video(tmp_path / "film.mp4", 12, 30.0)
    copy_segment(Span(tmp_path / "film.mp4"), tmp_path / "once.mp4", 12, 30.0)
    copy_segment(Span(tmp_path / "once.mp4"), tmp_path / "twice.mp4", 12, 30.0)
    assert not index_first(tmp_path / "film.mp4")
    assert (tmp_path / "once.mp4").read_bytes() == (tmp_path / "twice.mp4").read_bytes()
    assert coded(tmp_path / "film.mp4") == coded(tmp_path / "twice.mp4")


def test_a_longer_file_is_cut_where_nothing_later_is_needed(tmp_path: Path) -> None:
    write_video(tmp_path / "film.mp4", 12, 30.0, b_frames=0)
    copy_segment(Span(tmp_path / "film.mp4"), tmp_path / "new.mp4", 7, 30.0)
    with VideoFrames(tmp_path / "new.mp4") as pictures:
        assert [seen(pictures[k]) for k in range(7)] == list(range(7))
        assert len(pictures) == 7


def test_pictures_at_another_rate_get_the_times_of_their_rows(tmp_path: Path) -> None:
    write_video(tmp_path / "film.mp4", 12, 25.0)
    copy_segment(Span(tmp_path / "film.mp4"), tmp_path / "new.mp4", 12, 30.0)
    with VideoFrames(tmp_path / "new.mp4") as pictures:
        assert np.allclose(pictures.times, np.arange(12) / 30, atol=1e-4)


def test_an_episode_without_a_key_frame_at_its_start_is_coded_again_only_when_asked(tmp_path: Path) -> None:
    plan = Plan(key_frames=False)
    write(tmp_path / "set", plan)
    span = open_dataset(tmp_path / "set").episode(1).videos["cam_high"]
    with pytest.raises(NotCopyableError, match="does not begin with a key frame"):
        copy_segment(span, tmp_path / "new.mp4", 5, plan.fps)
    encode_segment(span, tmp_path / "new.mp4", 5, plan.fps)
    with VideoFrames(tmp_path / "new.mp4") as pictures:
        assert [seen(pictures[k]) for k in range(5)] == [shown(1, k) for k in range(5)]
        assert np.allclose(pictures.times, np.arange(5) / plan.fps, atol=1e-4)


def test_pictures_of_others_between_are_told(tmp_path: Path) -> None:
    write_video(tmp_path / "film.mp4", 12, 30.0, b_frames=3)
    with pytest.raises(NotCopyableError, match="pictures of others lie between"):
        copy_segment(Span(tmp_path / "film.mp4"), tmp_path / "new.mp4", 7, 30.0)


def test_too_few_pictures_are_told(tmp_path: Path) -> None:
    write_video(tmp_path / "film.mp4", 6, 30.0)
    with pytest.raises(RecordingError, match="has 6 frames for 7 rows"):
        copy_segment(Span(tmp_path / "film.mp4"), tmp_path / "new.mp4", 7, 30.0)
