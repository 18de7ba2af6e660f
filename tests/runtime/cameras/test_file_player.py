from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from runtime.cameras.base import CameraCondition, CapturedImage
from runtime.cameras.file import Config
from runtime.cameras.file_player import FileCamera
from runtime.core.clock import Clock, MonotonicClock, VirtualClock
from tests.runtime.cameras.movies import movie, number_of, until


def stepped(path: Path, clock: Clock, **settings: Any) -> FileCamera:
    camera = FileCamera("cam", Config(path=str(path), **settings), clock, threaded=False)
    camera.start()
    return camera


def shot(camera: FileCamera) -> CapturedImage:
    newest = camera.latest()
    assert newest is not None, camera.health().why
    return newest


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock(100.0)


@pytest.fixture
def film(tmp_path: Path) -> Path:
    return movie(tmp_path / "film.mp4", pictures=10, rate=10)


def test_the_first_picture_stands_and_stays_new_until_a_run_begins(film: Path, clock: VirtualClock) -> None:
    camera = stepped(film, clock)
    for _ in range(30):
        seen = shot(camera)
        assert number_of(seen.picture) == 0
        assert 0 <= clock.now() - seen.captured <= 0.1
        clock.advance(0.1)
    assert camera.health().condition is CameraCondition.LIVE


def test_a_run_plays_each_picture_when_it_is_due_and_stamps_it_so(film: Path, clock: VirtualClock) -> None:
    camera = stepped(film, clock)
    shot(camera)
    clock.advance(0.33)
    camera.begin_run()
    seen = []
    for _ in range(30):  # at 30 Hz, of a video of 10
        taken = shot(camera)
        seen.append((number_of(taken.picture), round((taken.captured - 100.33) * 10, 6)))
        clock.advance(1 / 30)
    assert [number for number, _ in seen] == [k // 3 for k in range(30)]
    assert all(number == when for number, when in seen)


def test_who_comes_late_gets_the_newest_picture_due(film: Path, clock: VirtualClock) -> None:
    camera = stepped(film, clock)
    camera.begin_run()
    shot(camera)
    clock.advance(0.75)
    assert number_of(shot(camera).picture) == 7


def test_it_loops_without_a_gap(film: Path, clock: VirtualClock) -> None:
    camera = stepped(film, clock)
    camera.begin_run()
    numbers = []
    for _ in range(25):
        numbers.append(number_of(shot(camera).picture))
        clock.advance(0.1)
    assert numbers == [k % 10 for k in range(25)]
    assert camera.health().losses == 0


def test_it_stops_at_its_end_grows_old_and_stands_again_after_the_run(
    film: Path, clock: VirtualClock
) -> None:
    camera = stepped(film, clock, at_end="stop")
    camera.begin_run()
    for _ in range(20):
        last = shot(camera)
        clock.advance(0.1)
    assert number_of(last.picture) == 9
    assert clock.now() - last.captured == pytest.approx(1.1)
    assert (camera.health().condition, camera.health().why) == (CameraCondition.ENDED, "the file is over")
    camera.end_run()
    assert number_of(shot(camera).picture) == 0
    assert camera.health().condition is CameraCondition.LIVE


def test_the_next_run_begins_with_the_first_picture(film: Path, clock: VirtualClock) -> None:
    camera = stepped(film, clock)
    for _ in range(2):
        camera.begin_run()
        assert number_of(shot(camera).picture) == 0
        clock.advance(0.5)
        assert number_of(shot(camera).picture) == 5


def test_a_thread_of_its_own_plays_by_the_real_clock(film: Path) -> None:
    camera = FileCamera("cam", Config(path=str(film)), MonotonicClock(), threaded=True)
    camera.start()
    try:
        until(camera.latest)
        assert number_of(shot(camera).picture) == 0
        camera.begin_run()
        seen: list[int] = []
        until(lambda: seen.append(number_of(shot(camera).picture)) or 5 in seen)
        assert sorted(set(seen)) == list(dict.fromkeys(seen)), "in order"
        camera.end_run()
        until(lambda: number_of(shot(camera).picture) == 0)
    finally:
        camera.close()


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (None, "there is no such file"),
        (b"hello" * 100, "not a video: Invalid data found when processing input"),
    ],
)
def test_what_is_no_video_is_said(
    tmp_path: Path, clock: VirtualClock, content: bytes | None, why: str
) -> None:
    path = tmp_path / "film.mp4"
    if content is not None:
        path.write_bytes(content)
    camera = stepped(path, clock)
    assert camera.latest() is None
    assert (camera.health().condition, camera.health().why) == (CameraCondition.OPENING, why)


def test_a_file_that_comes_later_is_played(tmp_path: Path, clock: VirtualClock) -> None:
    camera = stepped(tmp_path / "film.mp4", clock)
    assert camera.latest() is None
    movie(tmp_path / "film.mp4")
    assert number_of(shot(camera).picture) == 0


def test_a_size_that_does_not_fit_its_crop_is_said(film: Path, clock: VirtualClock) -> None:
    camera = stepped(film, clock, crop=[60, 0, 32, 32])
    assert camera.latest() is None
    assert "does not lie within its 64x48 pixels" in camera.health().why
