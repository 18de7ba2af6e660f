"""Which recordings are damaged, as the disk has it: DATA/quarantine/<uuid>.json; they stay as and where they are."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

from runtime.recording.files import disk_error, exclusive, sync_folder, to_json, write_atomic
from runtime.recording.marks import data_of, mark_file, read_mark
from runtime.recording.scrub import verify_episode
from runtime.recording.verdict import IntegrityCheck


def update_mark(verdict: IntegrityCheck) -> None:
    """Make the mark of an episode in DATA/episodes say what was found; one that is whole again loses it.

    It stays where the recording is whole by another seal than when it was marked, or has none any more: then nobody can
    say that its damage is mended. Of an episode that lies elsewhere nothing is kept. RecordingError where the disk does
    not take it.
    """
    data = data_of(verdict.path)
    if data is None or verdict.state == "open":
        return
    if verdict.state == "damaged":
        _mark(data, verdict)
    elif mark_file(data, verdict.path.name).exists():
        _take_back(data, verdict)


def marked_damage(data: Path, uuid: str) -> list[dict[str, Any]]:
    """Damage of an episode, a table per file as in Verdict.document; [] where nothing was found.

    An invalid mark counts as nothing found: the next scrub makes it anew.
    """
    mark = read_mark(data, uuid)
    return mark.damage if mark else []


def _mark(data: Path, verdict: IntegrityCheck) -> None:
    path, damage = mark_file(data, verdict.path.name), verdict.to_dict()["damage"]
    with exclusive(path.parent):
        known = read_mark(data, verdict.path.name)
        seal = (known.seal if known else None) or verdict.seal  # the first one: that of what was recorded
        if known is None or (known.damage, known.seal) != (damage, seal):
            told = {"uuid": verdict.path.name, "found": time.time(), "seal": seal, "damage": damage}
            write_atomic(path, to_json(told, "the mark", indent=1))


def _take_back(data: Path, verdict: IntegrityCheck) -> None:
    """Only after another look: somebody else may have found damage since the one that `verdict` is of."""
    path = mark_file(data, verdict.path.name)
    with exclusive(path.parent):
        mark = read_mark(data, verdict.path.name)
        if mark and mark.is_resolved_by(verify_episode(verdict.path)):
            _remove(path)


def _remove(path: Path) -> None:
    try:
        os.unlink(path)
        sync_folder(path.parent)
    except FileNotFoundError:
        return
    except OSError as error:
        raise disk_error("removing", path, error) from error
