"""A LeRobot camera as a camera of the deployment."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import pytest

from runtime.cameras.base import CameraCondition
from runtime.cameras.lerobot import Config
from runtime.cameras.lerobot_camera import LerobotCamera
from runtime.core.clock import MonotonicClock
from tests.processes import alive, eventually
from tests.runtime.lerobot.fake_lerobot import FakeLerobot


@pytest.fixture
def fake(tmp_path: Path) -> FakeLerobot:
    return FakeLerobot(tmp_path)


@pytest.fixture
def camera(fake: FakeLerobot) -> Iterator[LerobotCamera]:
    device = {"type": "eye", "folder": str(fake.device)}
    settings = Config.model_validate({"python": str(fake.python), "device": device, "rotate": 90})
    with contextlib.closing(LerobotCamera("cam_high", settings, MonotonicClock())) as opened:
        opened.start()
        eventually(lambda: opened.health().condition is CameraCondition.LIVE, "a picture")
        yield opened


def test_its_pictures_are_rgb_and_transformed_and_one_that_is_not_new_is_not_shown_again(
    fake: FakeLerobot, camera: LerobotCamera
) -> None:
    first = eventually(camera.latest, "a picture")
    assert first is not None
    assert first.picture.shape == (8, 8, 3)
    assert first.picture[0, 0].tolist() == [250, 10, 10]
    assert first.captured <= first.arrived
    fake.play("unseen")
    eventually(lambda: camera.health().condition is CameraCondition.LOST, "silence")
    assert "mute: it sent no picture within 2 s" in camera.health().why
    fake.play()
    eventually(lambda: camera.health().condition is CameraCondition.LIVE, "a picture again")
    process = int(fake.notes()[0]["connected"])
    camera.close()
    assert not alive(process)


def test_another_size_is_refused_and_an_unplugged_camera_is_connected_again(
    fake: FakeLerobot, camera: LerobotCamera
) -> None:
    fake.play("size")
    eventually(lambda: "its pictures were 8x8 and are 8x16 now" in camera.health().why, "the other size")
    fake.play("raises", "unplugged")
    eventually(lambda: "ConnectionError: no such port" in camera.health().why, "the reason")
    assert camera.faults()["camera_device_failed_cam_high"] > 0
    fake.play()
    eventually(lambda: camera.health().condition is CameraCondition.LIVE, "a picture again")
