import os
import threading
import time
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from runtime.errors import RecordingError
from runtime.recording.files import AppendFile
from runtime.recording.settings import RecordingSettings
from runtime.recording.video import CameraEncoder, FragmentedVideo, PictureQueue

from .samples import HEIGHT, SETTINGS, WIDTH, decoded, numbered, numbers

SIZE = (HEIGHT, WIDTH)


def encoded(path: Path, pictures: list[np.ndarray | None], fps: float = 30.0) -> Path:
    file = AppendFile(path)
    video = FragmentedVideo(file, SIZE, fps, SETTINGS)
    for picture in pictures:
        video.encode(picture)
    video.close()
    file.close()
    return path


def packets(path: Path) -> list[tuple[bool, Fraction, Fraction]]:
    """Whether it is a key frame, pts and dts [s] of each packet."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        return [
            (packet.is_keyframe, packet.pts * stream.time_base, packet.dts * stream.time_base)
            for packet in container.demux(stream)
            if packet.size
        ]


@pytest.mark.parametrize("fps", [30.0, 29.97, 12.5, 10.0, 1.0, 60.0])
def test_every_frame_is_there_at_its_exact_time_in_short_closed_groups(tmp_path: Path, fps: float) -> None:
    path = encoded(tmp_path / "a.mp4", [numbered(k) for k in range(40)], fps)
    found = packets(path)
    rate = Fraction(fps).limit_denominator(1001)
    assert [pts for _, pts, _ in found] == [k / rate for k in range(40)]
    assert all(pts == dts for _, pts, dts in found)  # no B-frames
    keys = [k for k, (key, _, _) in enumerate(found) if key]
    assert keys[0] == 0
    assert max(np.diff([*keys, 40])) <= max(1, min(15, int(fps / 2)))
    assert numbers(path) == list(range(40))


def test_it_is_h264_in_the_usual_pixel_format_with_its_colours_declared(tmp_path: Path) -> None:
    with av.open(str(encoded(tmp_path / "a.mp4", [numbered(1)] * 3))) as container:
        context = container.streams.video[0].codec_context
        assert (context.name, context.pix_fmt) == ("h264", "yuv420p")
        assert (context.width, context.height) == (WIDTH, HEIGHT)
        assert context.colorspace in (5, 6)  # both are the matrix of BT.601
        assert context.color_range == 1  # limited
        assert container.streams.video[0].average_rate == 30


def test_colours_come_back(tmp_path: Path) -> None:
    picture = np.zeros((*SIZE, 3), dtype=np.uint8)
    picture[:, : WIDTH // 2] = (200, 40, 60)
    picture[:, WIDTH // 2 :] = (30, 90, 220)
    found = decoded(encoded(tmp_path / "a.mp4", [picture] * 4))[-1].astype(int)
    assert np.abs(found[:, :24].mean(axis=(0, 1)) - (200, 40, 60)).max() < 5
    assert np.abs(found[:, 40:].mean(axis=(0, 1)) - (30, 90, 220)).max() < 5


def test_nothing_repeats_the_last_picture_and_is_black_at_first(tmp_path: Path) -> None:
    pictures = [None, None, numbered(5), None, numbered(6), None]
    path = encoded(tmp_path / "a.mp4", pictures)
    assert numbers(path) == [0, 0, 5, 5, 6, 6]
    assert decoded(path)[0].max() < 8


def test_pictures_may_be_read_only_and_not_contiguous(tmp_path: Path) -> None:
    bgr = np.ascontiguousarray(numbered(9)[..., ::-1])
    view = bgr[..., ::-1]
    view.flags.writeable = False
    assert numbers(encoded(tmp_path / "a.mp4", [view])) == [9]


def test_a_video_without_frames_can_be_opened(tmp_path: Path) -> None:
    path = encoded(tmp_path / "a.mp4", [])
    with av.open(str(path)) as container:
        assert container.streams.video[0].codec_context.width == WIDTH


def test_the_file_grows_by_whole_fragments_while_it_is_written(tmp_path: Path) -> None:
    file = AppendFile(tmp_path / "a.mp4")
    video = FragmentedVideo(file, SIZE, 30.0, SETTINGS)
    in_file = []
    for k in range(60):
        video.encode(numbered(k))
        in_file.append(len(decoded(tmp_path / "a.mp4")) if k >= 15 else 0)
    assert all(k + 1 - count <= 12 for k, count in enumerate(in_file[15:], start=15))
    video.close()
    file.close()
    assert numbers(tmp_path / "a.mp4") == list(range(60))


def test_the_queue_holds_a_bounded_number_of_pictures_and_counts_repeats() -> None:
    queue = PictureQueue(places=2)
    taken = [queue.put(numbered(k)) for k in range(5)]
    assert taken == [True, True, False, False, False]
    assert queue.put(None) is False
    assert queue.waiting() == 6
    queue.close()
    entries = [queue.take() for _ in range(4)]
    assert [entry if isinstance(entry, int) else "picture" for entry in entries[:3]] == [
        "picture",
        "picture",
        4,
    ]
    assert entries[3] is None


def test_a_place_is_free_again_once_a_picture_was_taken() -> None:
    queue = PictureQueue(places=1)
    assert queue.put(numbered(0))
    assert not queue.put(numbered(1))
    queue.take()
    assert queue.put(numbered(2))


def test_a_patient_caller_waits_for_a_place() -> None:
    queue = PictureQueue(places=1)
    queue.put(numbered(0))
    taker = threading.Thread(target=queue.take)
    taker.start()
    assert queue.put(numbered(1), patience=60.0)
    taker.join()


def test_an_encoder_thread_writes_what_it_was_given(tmp_path: Path) -> None:
    encoder = CameraEncoder("front", tmp_path / "a.mp4", SIZE, 30.0, SETTINGS)
    assert all(encoder.put(numbered(k)) for k in range(20))
    assert not encoder.put(None)
    encoder.finish()
    assert encoder.drain(time.monotonic() + 60)
    encoder.file.close()
    assert encoder.failure is None
    assert encoder.frames == 21
    assert numbers(tmp_path / "a.mp4") == [*range(20), 19]


def test_a_failing_encoder_names_its_camera_and_keeps_what_it_had(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = FragmentedVideo.encode

    def failing(self: FragmentedVideo, picture: np.ndarray | None) -> None:
        if self.frames == 20:
            raise ValueError("no more colours")
        real(self, picture)

    monkeypatch.setattr(FragmentedVideo, "encode", failing)
    encoder = CameraEncoder("front", tmp_path / "a.mp4", SIZE, 30.0, SETTINGS)
    for k in range(30):
        encoder.put(numbered(k))
    encoder.finish()
    assert encoder.drain(time.monotonic() + 60)
    encoder.file.close()
    assert "camera front" in str(encoder.failure)
    assert "no more colours" in str(encoder.failure)
    assert numbers(tmp_path / "a.mp4") == list(range(20))


def test_a_size_that_no_encoder_takes_is_an_error_at_once(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="camera front: no encoder for 65536x2"):
        CameraEncoder("front", tmp_path / "a.mp4", (2, 65536), 30.0, SETTINGS)


def sample_videos() -> list[Path]:
    folder = os.environ.get("EVA_SAMPLE_EPISODE")
    return sorted(Path(folder).glob("videos/*/*/*.mp4")) if folder else []


@pytest.mark.skipif(not sample_videos(), reason="EVA_SAMPLE_EPISODE names no dataset with videos")
def test_real_pictures_keep_at_least_38_db(tmp_path: Path) -> None:
    for video in sample_videos():
        with av.open(str(video)) as container:
            frames = container.decode(video=0)
            pictures = [frame.to_ndarray(format="rgb24") for frame, _ in zip(frames, range(90), strict=False)]
        file = AppendFile(tmp_path / f"{video.parent.name}.mp4")
        copy = FragmentedVideo(file, pictures[0].shape[:2], 30.0, RecordingSettings())
        for picture in pictures:
            copy.encode(picture)
        copy.close()
        file.close()
        found = decoded(file.path)
        errors = [np.mean((a.astype(float) - b) ** 2) for a, b in zip(found, pictures, strict=True)]
        assert 10 * np.log10(255**2 / np.array(errors)).min() >= 38


def test_the_way_of_each_picture_to_the_muxer_is_measured_and_repeats_do_not_count(tmp_path: Path) -> None:
    encoder = CameraEncoder("front", tmp_path / "a.mp4", SIZE, 30.0, SETTINGS)
    begun = time.monotonic()
    for k in range(3):
        encoder.put(numbered(k), 5.0, captured=begun - 10.0)
    encoder.put(None)
    encoder.finish()
    assert encoder.drain(time.monotonic() + 30.0)
    taken = encoder.muxed_ms
    encoder.file.close()
    assert taken is not None
    most = (time.monotonic() - begun + 10.0) * 1000
    assert 10_000 <= taken["p50"] <= taken["p99"] <= taken["max"] <= most


def test_pictures_whose_capture_is_unknown_give_no_such_figure(tmp_path: Path) -> None:
    encoder = CameraEncoder("front", tmp_path / "a.mp4", SIZE, 30.0, SETTINGS)
    encoder.put(numbered(1), 5.0)
    encoder.finish()
    assert encoder.drain(time.monotonic() + 30.0)
    assert encoder.muxed_ms is None
    encoder.file.close()


def test_each_frame_goes_to_the_muxer_at_once(tmp_path: Path) -> None:
    file = AppendFile(tmp_path / "a.mp4")
    video = FragmentedVideo(file, SIZE, 30.0, SETTINGS)
    for k in range(20):
        video.encode(numbered(k))
        assert len(video.muxed) == k + 1
    video.close()
    file.close()
    assert len(video.muxed) == 20
