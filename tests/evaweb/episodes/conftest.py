"""Real journals of a lockstep station, in a data folder that each test has for itself."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any
from uuid import UUID

import pytest

from evaweb.episodes import services
from evaweb.episodes.models import Episode
from evaweb.jobs import doorbell
from evaweb.jobs.models import Job
from evaweb.jobs.services import run_queue
from evaweb.stations.models import Station
from runtime.recording.export import write_export
from tests.once import made_once
from tests.runtime.lockstep_station import Station as Bench
from tests.runtime.lockstep_station import stubbed

STATUSES = ("finished", "interrupted")
FRAMES = 24
HELD = 6


@pytest.fixture(scope="session")
def recorded() -> dict[str, Path]:
    """Folders of one finished and one interrupted episode, by status; in both the robot was held for a while."""
    made = made_once("recorded", _record)
    return {status: next((made / status / "episodes").iterdir()) for status in STATUSES}


def _record(folder: Path) -> None:
    for status in STATUSES:
        bench = Bench(stubbed(folder / status))
        bench.running(12)
        bench.command("halt")
        bench.go(HELD)
        bench.command("resume")
        bench.go(FRAMES - 12 - HELD)
        if status == "interrupted":
            bench.guard.press("ann", "smoke")
            bench.go(3)
            episode = bench.episode()
        else:
            episode = bench.stop()
        assert episode.outcome is not None
        assert episode.outcome["status"] == status


@pytest.fixture
def data(settings: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The data folder of this test; no broker hears of its jobs."""
    settings.DATA_DIR = tmp_path
    monkeypatch.setattr(doorbell, "notify_workers", lambda queue: True)
    return tmp_path


@pytest.fixture
def station(db: None) -> Station:
    return Station.objects.create(name="bench", robot="agilex_piper", title="Bench one")


Put = Callable[..., Path]


@pytest.fixture
def put(data: Path, recorded: dict[str, Path]) -> Put:
    """Lay an episode into the data folder as the runtime does, with its table."""

    def copy(status: str = "finished") -> Path:
        target = data / "episodes" / recorded[status].name
        shutil.copytree(recorded[status], target)
        write_export(target, data)
        return target

    return copy


@pytest.fixture
def closed(put: Put, station: Station) -> Callable[..., Episode]:
    """An episode that its station has closed, its preview asked for."""

    def close(status: str = "finished") -> Episode:
        folder = put(status)
        return services.record_closed(station=station, data={"uuid": folder.name, "status": status})

    return close


@pytest.fixture
def previewed(closed: Callable[..., Episode]) -> Episode:
    """One that can be played."""
    episode = closed()
    assert run_queue("cpu") == 1
    assert Job.objects.get().error == ""
    return Episode.objects.get(uuid=UUID(str(episode.uuid)))
