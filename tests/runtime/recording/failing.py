"""An encoder that fails when a test wants it to."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from runtime.recording.video import FragmentedVideo


def fail_at(monkeypatch: pytest.MonkeyPatch, camera: str, frame: int, error: Exception) -> None:
    """Let the encoder of one camera fail at that frame."""
    real = FragmentedVideo.encode

    def failing(video: FragmentedVideo, picture: np.ndarray | None) -> None:
        if threading.current_thread().name == f"encoder {camera}" and video.frames == frame:
            raise error
        real(video, picture)

    monkeypatch.setattr(FragmentedVideo, "encode", failing)
