"""Which recordings are damaged, as the disk has it: DATA/quarantine/<uuid>.json; they stay as and where they are."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from runtime.errors import RecordingError
from runtime.recording.files import disk_fault, document, read_document, sync_folder, write_whole
from runtime.recording.scrub import Verdict

FOLDER = "quarantine"


def keep(verdict: Verdict) -> None:
    """Make the mark of an episode in DATA/episodes say what was found; one that is whole again loses it.

    Of an episode that lies elsewhere nothing is kept. RecordingError where the disk does not take it.
    """
    folder = verdict.path.absolute()
    if folder.parent.name != "episodes" or verdict.state == "open":
        return
    path = _file(folder.parents[1], folder.name)
    if verdict.state != "damaged":
        _remove(path)
    elif marked(folder.parents[1], folder.name) != (damage := verdict.document()["damage"]):
        _make(path.parent)
        told = {"uuid": folder.name, "found": time.time(), "damage": damage}
        write_whole(path, document(told, "the mark", indent=1))


def marked(data: Path, uuid: str) -> list[dict[str, Any]]:
    """What is wrong with an episode, a table per file as in Verdict.document; [] where nothing was found.

    A mark that is none is nothing found: the next scrub makes it anew.
    """
    try:
        damage = read_document(_file(data, uuid)).get("damage")
    except RecordingError:
        return []
    return damage if isinstance(damage, list) and all(map(_is_told, damage)) else []


def _is_told(one: object) -> bool:
    """Whether it is a table of Verdict.document."""
    if not isinstance(one, dict) or one.keys() != {"file", "what", "rows", "times", "text"}:
        return False
    words = all(isinstance(one[name], str) for name in ("file", "what", "text"))
    return words and _are_spans(one["rows"], int) and _are_spans(one["times"], float)


def _are_spans(value: object, kind: type) -> bool:
    """Whether it is a list of first and last."""
    spans = value if isinstance(value, list) else [None]
    return all(isinstance(span, list) and [type(end) for end in span] == [kind, kind] for span in spans)


def _file(data: Path, uuid: str) -> Path:
    return data / FOLDER / f"{uuid}.json"


def _make(folder: Path) -> None:
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise disk_fault("creating", folder, error) from error


def _remove(path: Path) -> None:
    try:
        path.unlink()
        sync_folder(path.parent)
    except FileNotFoundError:
        return
    except OSError as error:
        raise disk_fault("removing", path, error) from error
