"""Manifest and outcome in an episode's folder, as fields of the database."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from evaweb.episodes.models import EpisodeStatus
from runtime.recording.files import RecordingError, read_json
from runtime.recording.layout import Layout, simulated_bench
from runtime.recording.outcome_seal import (
    MANIFEST,
    OUTCOME,
    SEAL,
    read_outcome,
)
from runtime.recording.scrub import require_intact

CLOSED = (EpisodeStatus.FINISHED, EpisodeStatus.INTERRUPTED, EpisodeStatus.FAILED)


@dataclass(frozen=True, slots=True)
class RecordedEpisode:
    """Content of one folder; `facts` are fields of models.Episode, as far as the folder has them."""

    uuid: str
    station: str
    simulated: bool  # as declared by its deployment
    trial: Mapping[str, Any]  # as given in the run command; {} for none
    ended_at: datetime | None  # when the recording ended
    facts: Mapping[str, Any]
    session: Mapping[str, Any] = field(
        default_factory=dict
    )  # collection session: uuid and dataset; {} for none

    @property
    def closed(self) -> bool:
        """Whether the recorder, or repair, has closed the episode."""
        return self.facts["status"] in CLOSED


def read_recorded_episode(folder: Path) -> RecordedEpisode:
    """Read an episode's folder. Raises: RecordingError, which names the absent, damaged or invalid file."""
    manifest = read_json(folder / "manifest.json")
    layout = Layout.from_manifest(manifest)
    if folder.name != layout.uuid:
        raise RecordingError(f"{folder / 'manifest.json'} is of episode {layout.uuid}, not of {folder.name}")
    fields = {
        "kind": _text(manifest, "kind", 16) or "rollout",
        "mode": _text(manifest, "mode", 16),
        "strategy": _text(manifest, "strategy", 32),
        "task": _text(manifest, "task"),
        "robot": _text(_table(manifest, "robot"), "name", 63),
        "checkpoint": _text(_table(manifest, "checkpoint"), "name", 120),
        "operator": _text(manifest, "operator", 150),
        "configuration_hash": _text(manifest, "configuration_hash", 64),
    }
    facts = {name: value for name, value in fields.items() if value} | {
        "cameras": list(layout.cameras),
        "fps": layout.fps,
        "started_at": _time(manifest.get("started_wall")),
    }
    path = folder / OUTCOME
    if path.exists():
        require_intact(folder, (MANIFEST,))
    outcome = read_outcome(folder) if path.exists() else {}
    return RecordedEpisode(
        uuid=layout.uuid,
        station=_text(manifest, "station", 63),
        simulated=bool(simulated_bench(manifest)),
        trial=_table(manifest, "trial"),
        ended_at=_time(outcome.get("ended_wall")),
        facts=facts | _end(path, outcome),
        session=_table(manifest, "session"),
    )


def _end(path: Path, outcome: Mapping[str, Any]) -> dict[str, Any]:
    if not outcome:
        return {"status": EpisodeStatus.RECORDING}
    if outcome.get("status") not in CLOSED:
        allowed = ", ".join(CLOSED)
        raise RecordingError(f"{path}: status is {outcome.get('status')!r}, must be one of {allowed}")
    frames, duration = outcome.get("frames"), outcome.get("duration_s")
    if isinstance(frames, bool) or not isinstance(frames, int) or frames < 0:
        raise RecordingError(f"{path}: frames is {frames!r}, must be a whole number from 0")
    return {
        "status": EpisodeStatus(outcome["status"]),
        "reason": _text(outcome, "reason"),
        "seal": _text(outcome, SEAL, 64),
        "frames": frames,
        "duration_s": duration if isinstance(duration, int | float) else None,
        "control": _table(outcome, "control"),
        "policy": _table(outcome, "policy"),
    }


def _text(table: Mapping[str, Any], key: str, longest: int | None = None) -> str:
    value = table.get(key)
    if not isinstance(value, str):
        return ""
    return (
        value.encode("utf-8", "ignore").decode().replace("\x00", "")[:longest]
    )  # JSON may contain lone surrogates


def _table(table: Mapping[str, Any], key: str) -> dict[str, Any]:
    value = table.get(key)
    return dict(value) if isinstance(value, Mapping) else {}


def _time(value: object) -> datetime | None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        return datetime.fromtimestamp(value, UTC)
    except (OverflowError, OSError, ValueError):
        return None
