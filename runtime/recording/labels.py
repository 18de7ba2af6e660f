"""Users' labels of collected episodes: DATA/labels/<uuid>.jsonl, one line per label; the newest counts."""

from __future__ import annotations

import json
import uuid
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, get_args

from runtime.core.durable_files import append_durably
from runtime.core.errors import RecordingError
from runtime.core.types import Result

FOLDER = "labels"


@dataclass(frozen=True, slots=True)
class Label:
    """Label of an episode by a user.

    `time` is Unix time [s]; `result` is None until a user has judged the episode; discarding is final.
    """

    time: float
    by: str
    result: Result | None = None
    note: str = ""
    discarded: bool = False


def read_labels(data: Path, episode: str) -> list[Label]:
    """Return all labels of an episode, oldest first; torn or invalid lines are skipped. Raises RecordingError."""
    try:
        content = _file(data, episode).read_text("utf-8", "replace")
    except FileNotFoundError:
        return []
    except OSError as error:
        raise RecordingError(f"the labels of {episode} cannot be read: {error}") from error
    return [label for line in content.split("\n") if (label := _read(line)) is not None]


def latest_label(data: Path, episode: str) -> Label | None:
    """Return the newest label of an episode, which is the one that counts; None if it has no label."""
    labels = read_labels(data, episode)
    return labels[-1] if labels else None


def append_label(data: Path, episode: str, label: Label) -> None:
    """Write one label durably. Raises RecordingError if the disk fails."""
    path = _file(data, episode)
    line = json.dumps(asdict(label), ensure_ascii=False).encode() + b"\n"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a+b", buffering=0) as file:
            append_durably(file, line)
    except OSError as error:
        raise RecordingError(f"the label of {episode} is not on disk: {error}") from error


def _file(data: Path, episode: str) -> Path:
    try:
        named = str(uuid.UUID(episode))
    except ValueError:
        raise RecordingError(f"episode = {episode!r:.80}; allowed: the uuid of an episode") from None
    return data / FOLDER / f"{named}.jsonl"


def _read(line: str) -> Label | None:
    try:
        row: Any = json.loads(line.removeprefix("\ufeff"))
        label = Label(
            float(row["time"]), str(row["by"]), row["result"], str(row["note"]), row["discarded"] is True
        )
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
        return None
    return label if label.result is None or label.result in get_args(Result) else None
