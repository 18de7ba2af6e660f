"""Marks of damaged recordings on disk, DATA/quarantine/<uuid>.json; the recordings themselves are not touched."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

from runtime.core.durable_files import sync_folder
from runtime.recording.damage_marks import data_of, mark_file, read_mark
from runtime.recording.files import disk_error, exclusive, to_json, write_atomic
from runtime.recording.integrity import IntegrityCheck
from runtime.recording.scrub import verify_episode


def update_mark(verdict: IntegrityCheck) -> None:
    """Update the mark of an episode in DATA/episodes by the check `verdict`; remove it if the episode is intact again.

    The mark stays if the recording is now intact under another seal, or without one, because that does not show that
    its damage was mended. Episodes elsewhere have no marks. Raises RecordingError if the disk fails.
    """
    data = data_of(verdict.path)
    if data is None or verdict.state == "open":
        return
    if verdict.state == "damaged":
        _mark(data, verdict)
    elif mark_file(data, verdict.path.name).exists():
        _remove_mark(data, verdict)


def marked_damage(data: Path, uuid: str) -> list[dict[str, Any]]:
    """Return the damage of an episode, one table per file as in `IntegrityCheck.to_dict`; [] if none is known.

    An invalid mark counts as none: the next scrub writes it anew.
    """
    mark = read_mark(data, uuid)
    return mark.damage if mark else []


def _mark(data: Path, verdict: IntegrityCheck) -> None:
    path, damage = mark_file(data, verdict.path.name), verdict.to_dict()["damage"]
    with exclusive(path.parent):
        previous = read_mark(data, verdict.path.name)
        # The first seal: of the original recording.
        seal = (previous.seal if previous else None) or verdict.seal
        if previous is None or (previous.damage, previous.seal) != (damage, seal):
            fields = {"uuid": verdict.path.name, "found": time.time(), "seal": seal, "damage": damage}
            write_atomic(path, to_json(fields, "the mark", indent=1))


def _remove_mark(data: Path, verdict: IntegrityCheck) -> None:
    """Check the recording again, and remove its mark if that shows it to be intact.

    The second check is needed because another process may have found damage since `verdict`.
    """
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
