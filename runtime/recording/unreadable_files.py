"""Damage of a recording without digests: files that cannot be read in full."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from runtime.core.errors import RecordingError
from runtime.recording.fragments import count_frames
from runtime.recording.integrity import Damage
from runtime.recording.outcome_seal import OUTCOME
from runtime.recording.reader import Episode, open_episode, read_events
from runtime.recording.tables import SCHEMAS, read_table

EVENTS = "events.jsonl"


def find_unreadable(folder: Path) -> tuple[Damage, ...]:
    """Return damage for files of the closed episode in `folder` that are torn, empty or absent.

    Tables and events of a failed episode may end anywhere, because they were recorded like that.
    """
    try:
        episode = open_episode(folder)
        damages = [*_videos(episode), *([] if _failed(episode) else [*_tables(episode), *_events(folder)])]
    except RecordingError as error:
        return (Damage(OUTCOME, f"has no digests, and {error}"),)
    return tuple(damages)


def _failed(episode: Episode) -> bool:
    return (episode.outcome or {}).get("status") == "failed"


def _tables(episode: Episode) -> Iterator[Damage]:
    for name, schema in SCHEMAS.items():
        path = episode.path / f"{name}.arrow"
        read = read_table(path, schema(episode.layout))
        if not path.exists():
            yield Damage(path.name, "is absent")
        elif not read.closed:
            yield Damage(path.name, f"is torn: {read.table.num_rows} rows can be read, and it has no end")


def _videos(episode: Episode) -> Iterator[Damage]:
    for camera, path in episode.videos.items():
        frames, expected = count_frames(path), episode.frame_count(camera)
        if frames < expected:
            yield Damage(path.name, f"is torn: {frames} frames can be read, its rows want {expected}")


def _events(folder: Path) -> Iterator[Damage]:
    if not (folder / EVENTS).exists():
        yield Damage(EVENTS, "is absent")
    elif torn := read_events(folder / EVENTS).torn:
        yield Damage(EVENTS, f"is torn: {torn} of its lines cannot be read")
