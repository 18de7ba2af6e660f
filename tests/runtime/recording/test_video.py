import os
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
import zmq

from runtime.datasets.remux import remux
from runtime.recording.codecs import CODECS, CodecName
from runtime.recording.encoder_check import is_encoder_usable
from runtime.recording.encoder_queue import RUN, encode_count
from runtime.recording.files import AppendFile
from runtime.recording.fragments import count_frames
from runtime.recording.settings import RecordingSettings
from runtime.recording.video import FragmentedVideo

from .samples import HEIGHT, SETTINGS, WIDTH, decoded, number_of, numbered, numbers

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


def sample_videos() -> list[Path]:
    folder = os.environ.get("EVA_SAMPLE_EPISODE")
    return sorted(Path(folder).glob("videos/*/*/*.mp4")) if folder else []


@pytest.mark.exhaustive
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


def test_each_frame_goes_to_the_muxer_at_once(tmp_path: Path) -> None:
    file = AppendFile(tmp_path / "a.mp4")
    video = FragmentedVideo(file, SIZE, 30.0, SETTINGS)
    for k in range(20):
        video.encode(numbered(k))
        assert video.muxed == k + 1
    video.close()
    file.close()
    assert video.muxed == 20


def held(path: Path, counts: list[int], settings: RecordingSettings = SETTINGS) -> Path:
    """Picture k + 1 and then so many repeats of it, for each k."""
    file = AppendFile(path)
    video = FragmentedVideo(file, SIZE, 30.0, settings)
    for k, count in enumerate(counts):
        video.encode(numbered(k + 1))
        video.repeat(count)
    assert video.frames == sum(counts) + len(counts)
    video.close()
    assert video.muxed == video.frames
    file.close()
    return path


@pytest.mark.some(5)
@pytest.mark.parametrize("codec", list(CODECS))
@pytest.mark.parametrize("counts", [[1, 2, 3], [4, 5, 90, 0, 7], [RUN, RUN + 1, 300]])
def test_repeats_are_frames_of_their_own_however_they_were_made(
    tmp_path: Path, codec: CodecName, counts: list[int]
) -> None:
    if not is_encoder_usable(codec):
        pytest.skip(f"{codec} does not work on this machine")
    path = held(tmp_path / "a.mp4", counts, SETTINGS.model_copy(update={"codec": codec}))
    assert numbers(path) == [k + 1 for k, count in enumerate(counts) for _ in range(count + 1)]
    times = [pts for _, pts, _ in packets(path)]
    assert times == [Fraction(k, 30) for k in range(len(times))]
    assert count_frames(path) == len(times)


@pytest.mark.parametrize("codec", sorted(CODECS))
def test_no_thread_of_an_encoder_is_real_time(tmp_path: Path, codec: CodecName) -> None:
    if not is_encoder_usable(codec):
        pytest.skip(f"{codec} does not work on this machine")
    file = AppendFile(tmp_path / "a.mp4")
    video = FragmentedVideo(file, SIZE, 30.0, SETTINGS.model_copy(update={"codec": codec}))
    for k in range(3):
        video.encode(numbered(k))
    with zmq.Context() as context, context.socket(zmq.PUSH):  # its threads begin in the caller's class
        classes = {os.sched_getscheduler(int(thread)) for thread in os.listdir("/proc/self/task")}
    video.close()
    file.close()
    assert classes == {os.SCHED_OTHER}


@pytest.mark.exhaustive
def test_a_long_run_of_repeats_costs_three_codings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = AppendFile(tmp_path / "a.mp4")
    video = FragmentedVideo(file, SIZE, 30.0, SETTINGS)
    video.encode(numbered(1))
    coded = []
    real = FragmentedVideo._code

    def counted(self: FragmentedVideo, *, key: bool) -> list[Any]:
        coded.append(key)
        return real(self, key=key)

    monkeypatch.setattr(FragmentedVideo, "_code", counted)
    for count in (RUN - 1, RUN, 2_001):
        coded.clear()
        video.repeat(count)
        assert len(coded) == encode_count(count)
    video.encode(numbered(2))
    assert coded[-1], "what follows copies begins a group of its own"
    video.close()
    file.close()
    assert numbers(file.path)[-2:] == [1, 2]


def test_a_run_of_copies_survives_being_copied_into_a_dataset(tmp_path: Path) -> None:
    counts = [3, 40, 5, 0]
    source = held(tmp_path / "a.mp4", counts)
    total = sum(counts) + len(counts)
    remux(source, tmp_path / "b.mp4", total, 30.0)
    assert numbers(tmp_path / "b.mp4") == numbers(source)
    coded = []
    for path in (source, tmp_path / "b.mp4"):
        with av.open(str(path)) as container:
            coded.append([bytes(packet) for packet in container.demux(video=0) if packet.size])
    assert coded[0] == coded[1]


def test_a_decoder_that_begins_at_any_key_frame_sees_the_same(tmp_path: Path) -> None:
    path = held(tmp_path / "a.mp4", [3, 11, 6, 20])
    shown = numbers(path)
    for start in (0, 5, 9, 17, 30, 43):
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            container.seek(int(start / 30 / stream.time_base), stream=stream)
            frames = [frame for frame in container.decode(stream) if frame.time >= start / 30 - 1e-6]
        assert [number_of(frame.to_ndarray(format="rgb24")) for frame in frames] == shown[start:]


def test_pictures_are_scaled_to_the_size_of_the_video(tmp_path: Path) -> None:
    file = AppendFile(tmp_path / "a.mp4")
    video = FragmentedVideo(file, (HEIGHT // 2, WIDTH // 2), 30.0, SETTINGS)
    for k in range(5):
        video.encode(numbered(k))
    video.close()
    file.close()
    found = decoded(file.path)
    assert [picture.shape for picture in found] == [(HEIGHT // 2, WIDTH // 2, 3)] * 5
    doubled = [picture.repeat(2, axis=0).repeat(2, axis=1) for picture in found]
    assert [number_of(picture) for picture in doubled] == list(range(5))


def test_a_longer_group_is_what_was_asked_for(tmp_path: Path) -> None:
    file = AppendFile(tmp_path / "a.mp4")
    video = FragmentedVideo(file, SIZE, 30.0, SETTINGS.model_copy(update={"gop": 50}))
    for k in range(120):
        video.encode(numbered(k))
    video.close()
    file.close()
    assert [k for k, (key, _, _) in enumerate(packets(file.path)) if key] == [0, 50, 100]
