import threading
import time
from pathlib import Path

import numpy as np
import pytest

from runtime.core.errors import RecordingError
from runtime.recording.encoder import CameraEncoder
from runtime.recording.video import FragmentedVideo
from tests.processes import PATIENCE_S

from .samples import HEIGHT, SETTINGS, WIDTH, numbered, numbers

SIZE = (HEIGHT, WIDTH)


def test_an_encoder_thread_writes_what_it_was_given(tmp_path: Path) -> None:
    encoder = CameraEncoder("front", tmp_path / "a.mp4", SIZE, 30.0, SETTINGS)
    assert all(encoder.put(numbered(k)) for k in range(20))
    assert not encoder.put(None)
    encoder.finish()
    assert encoder.drain(time.monotonic() + PATIENCE_S)
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
    assert encoder.drain(time.monotonic() + PATIENCE_S)
    encoder.file.close()
    assert "camera front" in str(encoder.failure)
    assert "no more colours" in str(encoder.failure)
    assert numbers(tmp_path / "a.mp4") == list(range(20))


def test_a_size_that_no_encoder_takes_is_an_error_at_once(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="camera front: no encoder libx264 for 65536x2"):
        CameraEncoder("front", tmp_path / "a.mp4", (2, 65536), 30.0, SETTINGS)


def test_the_way_of_each_picture_to_the_muxer_is_measured_and_repeats_do_not_count(tmp_path: Path) -> None:
    encoder = CameraEncoder("front", tmp_path / "a.mp4", SIZE, 30.0, SETTINGS)
    begun = time.monotonic()
    for k in range(3):
        encoder.put(numbered(k), PATIENCE_S, captured=begun - 10.0)
    encoder.put(None)
    encoder.finish()
    assert encoder.drain(time.monotonic() + PATIENCE_S)
    taken = encoder.muxed_ms
    encoder.file.close()
    assert taken is not None
    most = (time.monotonic() - begun + 10.0) * 1000
    assert 10_000 <= taken["p50"] <= taken["p99"] <= taken["max"] <= most


def test_pictures_whose_capture_is_unknown_give_no_such_figure(tmp_path: Path) -> None:
    encoder = CameraEncoder("front", tmp_path / "a.mp4", SIZE, 30.0, SETTINGS)
    encoder.put(numbered(1), PATIENCE_S)
    encoder.finish()
    assert encoder.drain(time.monotonic() + PATIENCE_S)
    assert encoder.muxed_ms is None
    encoder.file.close()


class Held:
    """Encoders that stand still from frame `at` on until they are let go."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, at: int) -> None:
        self.free = threading.Event()
        self.reached = threading.Event()
        real = FragmentedVideo.encode

        def encode(video: FragmentedVideo, picture: np.ndarray | None) -> None:
            if video.frames == at:
                self.reached.set()
                assert self.free.wait(PATIENCE_S)
            real(video, picture)

        monkeypatch.setattr(FragmentedVideo, "encode", encode)


def test_one_that_is_too_far_behind_is_given_up_and_keeps_what_it_had(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    held = Held(monkeypatch, at=3)
    settings = SETTINGS.model_copy(update={"give_up_s": 1.0, "queue_frames": 2})
    encoder = CameraEncoder("front", tmp_path / "a.mp4", SIZE, 30.0, settings)
    for k in range(3):
        encoder.put(numbered(k), PATIENCE_S)
    encoder.put(numbered(3), PATIENCE_S)
    assert held.reached.wait(PATIENCE_S)
    put = 0
    while encoder.failure is None:
        encoder.put(numbered(4 + put))
        put += 1
        assert put <= 40
    assert "camera front: the encoder is 31 frames (1.0 s) behind and is given up" in str(encoder.failure)
    assert not encoder.put(numbered(0))
    held.free.set()
    encoder.finish()
    assert encoder.drain(time.monotonic() + PATIENCE_S)
    encoder.file.close()
    assert numbers(tmp_path / "a.mp4") == [0, 1, 2, 3]


def test_a_patient_caller_is_never_too_far_ahead(tmp_path: Path) -> None:
    settings = SETTINGS.model_copy(update={"give_up_s": 1.0, "queue_frames": 1})
    encoder = CameraEncoder("front", tmp_path / "a.mp4", SIZE, 30.0, settings)
    assert all(encoder.put(numbered(k), PATIENCE_S) for k in range(100))
    encoder.finish()
    assert encoder.drain(time.monotonic() + PATIENCE_S)
    encoder.file.close()
    assert encoder.failure is None
    assert numbers(tmp_path / "a.mp4") == list(range(100))


def test_what_waits_together_is_coded_as_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    held = Held(monkeypatch, at=0)
    encoder = CameraEncoder("front", tmp_path / "a.mp4", SIZE, 30.0, SETTINGS)
    encoder.put(numbered(7))
    assert held.reached.wait(PATIENCE_S)
    assert not any(encoder.put(None) for _ in range(100))
    encoder.put(numbered(8))
    held.free.set()
    encoder.finish()
    assert encoder.drain(time.monotonic() + PATIENCE_S)
    encoder.file.close()
    assert numbers(tmp_path / "a.mp4") == [7] * 101 + [8]
