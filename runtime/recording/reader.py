"""Reading of an episode's folder: manifest, outcome, tables and videos, cut to their common length."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from runtime.core.errors import RecordingError
from runtime.recording.archive_index import require_not_stored
from runtime.recording.files import read_json
from runtime.recording.layout import Layout
from runtime.recording.outcome_seal import OUTCOME, read_outcome, without_digests
from runtime.recording.tables import SCHEMAS, read_table


@dataclass(frozen=True, slots=True)
class Episode:
    """Episode as it is on disk; tables are pyarrow.Table with the columns of runtime.recording.tables.

    Its files are not verified against the digests in its outcome, and `outcome` does not contain them; for a check see
    runtime.recording.scrub.

    `rows` has exactly `frames` rows, and frame k of every video belongs to row k for k < `frames`. A video may have
    more frames, and that of a lost camera has fewer: see `frame_count`. Without an outcome the episode is being written
    or was cut off: then `frames` only counts rows, and videos may have fewer frames.
    """

    path: Path
    layout: Layout
    manifest: Mapping[str, object]
    outcome: Mapping[str, object] | None
    frames: int
    rows: Any
    ticks: Any
    smoothed: Any
    raw: Any
    events: tuple[Mapping[str, object], ...]
    videos: Mapping[str, Path]

    @property
    def lost(self) -> Mapping[str, Mapping[str, Any]]:
        """Cameras whose video ended before the episode, each with `row`, the first without a picture, and `reason`."""
        lost = (self.outcome or {}).get("lost_cameras")
        return lost if isinstance(lost, Mapping) else {}

    def frame_count(self, camera: str) -> int:
        """Return the number of rows, from the first, that have a frame of that camera."""
        return min(self.frames, int(self.lost[camera]["row"])) if camera in self.lost else self.frames


def open_episode(path: Path, videos: bool = True) -> Episode:
    """Read the episode in folder `path`; without `videos`, `Episode.videos` is empty.

    A reader of numbers needs no videos, which may be in the lab's store. Raises RecordingError with the file that is
    absent or damaged, or in the store.
    """
    manifest = read_json(path / "manifest.json")
    layout = Layout.from_manifest(manifest)
    outcome = without_digests(read_outcome(path)) if (path / OUTCOME).exists() else None
    tables = {
        name: read_table(path / f"{name}.arrow", schema(layout)).table for name, schema in SCHEMAS.items()
    }
    frames = tables["rows"].num_rows if outcome is None else _frames(path, outcome, tables["rows"].num_rows)
    return Episode(
        path=path,
        layout=layout,
        manifest=manifest,
        outcome=outcome,
        frames=frames,
        rows=tables["rows"].slice(0, frames),
        ticks=tables["ticks"],
        smoothed=tables["smoothed"],
        raw=tables["raw"],
        events=tuple(json.loads(line) for line in read_events(path / "events.jsonl").lines),
        videos={camera: _video(path, camera) for camera in layout.cameras} if videos else {},
    )


@dataclass(frozen=True, slots=True)
class EventsRead:
    """Whole lines of an event log, and the number of torn lines."""

    lines: tuple[bytes, ...]
    torn: int


def read_events(path: Path) -> EventsRead:
    """Return all complete events of an event log; a complete event is a line that is one JSON object.

    If the log does not exist, there are no events. Raises RecordingError if the log cannot be read.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return EventsRead((), 0)
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror}") from error
    lines = data.split(b"\n")
    whole = tuple(line for line in lines[:-1] if _is_object(line))
    return EventsRead(whole, len(lines) - len(whole) - (not lines[-1]))


def _is_object(line: bytes) -> bool:
    try:
        return isinstance(json.loads(line), dict)
    except (ValueError, RecursionError):
        return False


def _frames(path: Path, outcome: Mapping[str, object], rows: int) -> int:
    frames = outcome.get("frames")
    if isinstance(frames, bool) or not isinstance(frames, int) or frames < 0:
        raise RecordingError(f"{path / 'outcome.json'}: frames is {frames!r}, must be a whole number from 0")
    if rows < frames:
        raise RecordingError(
            f"{path / 'rows.arrow'} is damaged: {rows} rows readable, its outcome says {frames}"
        )
    return frames


def _video(path: Path, camera: str) -> Path:
    video = path / f"{camera}.mp4"
    if not video.is_file():
        require_not_stored(video)
        raise RecordingError(f"{video} is absent, but the manifest lists camera {camera}")
    return video
