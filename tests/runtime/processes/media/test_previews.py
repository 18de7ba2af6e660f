"""Small pictures for who looks."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest
import simplejpeg

from runtime.core.types import Observation
from runtime.processes.media.previews import Previews
from tests.runtime.lockstep_station import stubbed


class Looking:
    """What is shown of a station's pictures."""

    def __init__(self, folder: Path) -> None:
        made = stubbed(folder, bus={"preview_rate": 15.0}).spec
        self.previews, self._dim = Previews(made), made.robot.dim
        self._socket, self.previews._publisher = self.previews._publisher, self  # type: ignore[assignment]
        self._shown: list[tuple[str, bytes]] = []
        self.topics = {"camera/"}
        self.begun: list[str] = []

    def poll_subscriptions(self) -> list[str]:
        begun, self.begun = self.begun, []
        self.topics.update(begun)
        return begun

    def has_subscriber(self, stream: str) -> bool:
        return stream.startswith(tuple(self.topics))

    def publish(self, stream: str, jpeg: bytes) -> None:
        self._shown.append((stream, jpeg))

    def rebind_if_unreachable(self) -> bool:
        return False

    def seen(self, arrived: float, captured: float, brightness: int = 90) -> list[tuple[str, bytes]]:
        """What comes of an observation with one picture."""
        picture = np.full((480, 640, 3), brightness, np.uint8)
        self._shown = []
        self.previews(
            Observation(
                sequence=1,
                arrived=arrived,
                captured=MappingProxyType({"joints": arrived, "cam_high": captured}),
                qpos=np.zeros(self._dim, np.float32),
                pictures=MappingProxyType({"cam_high": picture}),
            )
        )
        return self._shown

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def looking(tmp_path: Path) -> Iterator[Looking]:
    made = Looking(tmp_path)
    yield made
    made.close()


def test_a_picture_is_shown_small(looking: Looking) -> None:
    ((stream, jpeg),) = looking.seen(1.0, 0.99, 120)
    picture = simplejpeg.decode_jpeg(jpeg)
    assert stream == "camera/cam_high"
    assert picture.shape == (240, 320, 3)
    assert abs(int(picture.mean()) - 120) < 3


def test_one_that_only_stands_in_further_observations_is_not_shown_again(looking: Looking) -> None:
    assert looking.seen(1.0, 0.99)
    assert looking.seen(1.5, 0.99) == []
    assert looking.seen(2.0, 0.99) == []
    assert looking.seen(2.5, 2.49)


def test_more_than_are_wanted_are_not_shown(looking: Looking) -> None:
    shown = [len(looking.seen(1.0 + number / 30, 1.0 + number / 30)) for number in range(8)]
    assert shown == [1, 0, 1, 0, 1, 0, 1, 0]


def test_what_nobody_looks_at_is_not_made_and_who_begins_to_look_sees_it_at_once(
    looking: Looking, monkeypatch: pytest.MonkeyPatch
) -> None:
    looking.topics = set()
    with monkeypatch.context() as broken:
        broken.delattr(simplejpeg, "encode_jpeg")
        assert looking.seen(1.0, 1.0) == []
        assert not looking.previews.is_requested()
    looking.begun = ["camera/cam_high"]
    assert looking.previews.is_requested()
    assert len(looking.seen(1.001, 1.0)) == 1


def test_another_that_begins_to_look_is_shown_what_is_not_due(looking: Looking) -> None:
    assert looking.seen(1.0, 1.0)
    looking.begun = ["camera/cam"]
    assert looking.seen(1.001, 1.0)
    assert looking.seen(1.002, 1.0) == []
