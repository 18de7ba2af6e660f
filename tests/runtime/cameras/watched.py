"""A live camera that looks at a stand-in server, for as long as a test does."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

import pytest

from runtime.cameras import mjpeg, rtsp
from runtime.cameras.base import CameraCondition
from runtime.cameras.live_camera import LiveCamera
from runtime.core.clock import MonotonicClock
from runtime.standins.camera_server import CameraServer
from runtime.standins.mjpeg_server import MjpegServer
from runtime.standins.rtsp_server import RtspServer

CLOCK = MonotonicClock()
KINDS = {"rtsp": (RtspServer, rtsp), "mjpeg": (MjpegServer, mjpeg)}
both = pytest.mark.parametrize("kind", KINDS)


@contextmanager
def looking(module: ModuleType, url: str, **settings: Any) -> Iterator[LiveCamera]:
    config = module.Config(url=url, **{"open_s": 1.5, "read_s": 0.5, **settings})
    camera = LiveCamera("wrist", config.kind, config, module.address(config), CLOCK)
    camera.start()
    try:
        yield camera
    finally:
        camera.close()


@contextmanager
def watched(kind: str, fault: str = "", **settings: Any) -> Iterator[tuple[CameraServer, LiveCamera]]:
    made, module = KINDS[kind]
    server = made()
    server.fault = fault
    try:
        with looking(module, server.start(), **settings) as camera:
            yield server, camera
    finally:
        server.close()


def live(camera: LiveCamera) -> bool:
    return camera.health().condition is CameraCondition.LIVE


def lost(camera: LiveCamera) -> bool:
    return camera.health().condition is CameraCondition.LOST
