"""A station that collects, a session there, and demonstrations of it that were really recorded."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest
from django.contrib.auth.models import User

from evaweb.collect import services
from evaweb.collect import station_events as following
from evaweb.collect.models import CollectSession, Demonstration
from evaweb.episodes import services as episodes
from evaweb.stations.models import Station
from runtime.core.types import Result
from runtime.recording.export import write_export
from runtime.recording.labels import Label, append_label
from tests.evaweb.episodes.conftest import data, recorded, station
from tests.evaweb.trials.builders import FakeConnection
from tests.runtime.recording.samples import resealed

__all__ = ["data", "recorded", "station"]

JOINTS = ["left_arm.joint0", "left_arm.joint1"]
SETUP = {
    "robot": "agilex_piper",
    "groups": ["left_arm"],
    "joints": JOINTS,
    "cameras": {"cam_high": {"width": 64, "height": 48}},
    "fps": 30.0,
    "streams": {"qvel": False, "effort": False, "eef": True, "eef_action": True},
}


def collecting(**changes: Any) -> dict[str, Any]:
    """What a station's snapshot says of collecting."""
    return {"dataset": "cups", "cameras": ["cam_high"], "episode": None, "setup": SETUP, **changes}


@pytest.fixture
def at(monkeypatch: pytest.MonkeyPatch) -> FakeConnection:
    """What stands where wires to runtimes stand: a station that collects, and that nobody commands."""
    made = FakeConnection()
    made.snapshot = {**made.snapshot, "collect": collecting(), "lease": {"holder": "", "epoch": 0}}
    for place in ("stations.commands", "collect.services", "collect.station_commands"):
        monkeypatch.setattr(f"evaweb.{place}.connection_to", lambda name: made)
    return made


@pytest.fixture
def session(at: FakeConnection, data: Path, station: Station, ann: User) -> CollectSession:
    return services.open_session(user=ann, station=station, task="stack the cups", target=20)


Demonstrate = Callable[..., Demonstration]


@pytest.fixture
def demonstrate(data: Path, recorded: dict[str, Path], session: CollectSession) -> Demonstrate:
    """Lay an episode of the session into the data folder as the station does, and let the station tell of it."""

    def do(
        result: Result | None = None, *, status: str = "finished", of: CollectSession | None = None
    ) -> Demonstration:
        chosen, uuid = of or session, str(uuid4())
        target = data / "episodes" / uuid
        shutil.copytree(recorded[status], target)
        path = target / "manifest.json"
        manifest = json.loads(path.read_text())
        told = {"kind": "demonstration", "mode": "collect", "task": chosen.task, "operator": "ann"}
        named = {"uuid": str(chosen.pk), "dataset": chosen.dataset}
        path.write_text(json.dumps(manifest | told | {"uuid": uuid, "session": named}))
        resealed(target)
        write_export(target, data)
        closed = {"uuid": uuid, "status": status}
        episodes.record_closed(station=chosen.station, data=closed)
        made = following.apply_station_event(event={"kind": "episode_closed", "data": closed})
        assert made is not None
        return made if result is None else labelled(data, made, result)

    return do


def labelled(data: Path, made: Demonstration, result: Result | None, **said: Any) -> Demonstration:
    """As the station writes it down and tells of it."""
    append_label(data, str(made.pk), Label(1_700_000_000.0, "ann", result, **said))
    told = following.apply_station_event(event={"kind": "labelled", "data": {"episode": str(made.pk)}})
    assert told is not None
    return told
