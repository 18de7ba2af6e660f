"""Integrity check of a recording: every file against the digests in its outcome."""

from __future__ import annotations

import errno
import hashlib
import os
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, BinaryIO

from runtime.core.errors import RecordingError
from runtime.recording.archive_index import require_not_stored, stored_files
from runtime.recording.damage_marks import known_damage
from runtime.recording.digests import FileDigest
from runtime.recording.files import disk_error, read_json
from runtime.recording.integrity import (
    Damage,
    DamagedError,
    IntegrityCheck,
    State,
)
from runtime.recording.outcome_seal import (
    COPY,
    DIGESTS,
    MANIFEST,
    OUTCOME,
    OUTCOME_COPY,
    SEAL,
    read_outcome,
)
from runtime.recording.unreadable_files import find_unreadable


def verify_episode(folder: Path, files: Collection[str] = ()) -> IntegrityCheck:
    """Check all files of the episode in `folder`, or only `files`, against their digests; return the result.

    Raises RecordingError if the folder is no episode or cannot be read, or if one of these files is in the lab's store:
    it is absent then, and not damaged.
    """
    if not (folder / OUTCOME).exists():
        return _without_outcome(folder)
    try:
        outcome = read_outcome(folder)
    except RecordingError as error:
        return _verify_by_copy(folder, Damage(OUTCOME, f"is damaged: {error}"))
    if DIGESTS in outcome:
        return _compare_digests(folder, outcome, files)
    if (folder / OUTCOME_COPY).exists():
        return _verify_by_copy(folder, Damage(OUTCOME, f"has lost its digests: there is {OUTCOME_COPY}"))
    damage = () if files else find_unreadable(folder)
    return IntegrityCheck(folder, "damaged" if damage else "unsealed", damage)


def _without_outcome(folder: Path) -> IntegrityCheck:
    """Return the check of an episode without an outcome.

    It counts as open, unless a copy or a mark shows that it was closed.
    """
    if (folder / OUTCOME_COPY).exists():
        check = _verify_by_copy(folder, Damage(OUTCOME, "is absent, and was there"))
        if check.seal and len(check.damage) == 1:
            reason = f"it has no outcome, and a whole copy of it, {OUTCOME_COPY}: repair brings it back"
            return IntegrityCheck(folder, "open", bytes=check.bytes, seal=check.seal, why=reason)
        return check
    damage = known_damage(IntegrityCheck(folder, "open"))
    if not damage and not (folder / MANIFEST).exists():
        raise RecordingError(f"{folder} is no episode: there is no {MANIFEST} in it")
    return IntegrityCheck(folder, "damaged" if damage else "open", damage)


def _verify_by_copy(folder: Path, lost: Damage) -> IntegrityCheck:
    """Return the check of an episode whose outcome is lost or damaged, by the copy of the outcome if that is intact."""
    if not (folder / OUTCOME_COPY).exists():
        return IntegrityCheck(folder, "damaged", (lost,))
    try:
        outcome = read_outcome(folder, OUTCOME_COPY)
    except RecordingError as error:
        return IntegrityCheck(folder, "damaged", (lost, Damage(OUTCOME_COPY, f"is damaged: {error}")))
    if DIGESTS not in outcome:
        return IntegrityCheck(folder, "damaged", (lost, Damage(OUTCOME_COPY, "is no copy of an outcome")))
    check = _compare_digests(folder, outcome, (), second=False)
    return IntegrityCheck(folder, "damaged", (lost, *check.damage), check.bytes, check.seal)


def _compare_digests(
    folder: Path, outcome: Mapping[str, Any], files: Collection[str], second: bool = True
) -> IntegrityCheck:
    """Compare all files, or only `files`, with the digests in `outcome`; return the result.

    If `second` and all files are compared, the copy of the outcome is checked too.
    """
    manifest = _manifest(folder)
    digests = {name: expected for name, expected in outcome[DIGESTS].items() if not files or name in files}
    damages = [_damage(folder / name, digest, manifest) for name, digest in digests.items()]
    damages += [_verify_copy(folder)] if second and not files and COPY in outcome else []
    damage = tuple(entry for entry in damages if entry is not None)
    size = sum(digest["bytes"] for digest in digests.values())
    repair = outcome.get("repair")
    unproven = str(repair.get("unproven", "")) if isinstance(repair, Mapping) else ""
    state: State = "damaged" if damage else "unsealed" if unproven else "sound"
    return IntegrityCheck(folder, state, damage, size, str(outcome[SEAL]), repair is not None, unproven)


def _verify_copy(folder: Path) -> Damage | None:
    try:
        same = (folder / OUTCOME_COPY).read_bytes() == (folder / OUTCOME).read_bytes()
    except OSError as error:
        return Damage(OUTCOME_COPY, f"cannot be read: {error.strerror}")
    return None if same else Damage(OUTCOME_COPY, f"is not the copy of {OUTCOME} that it was")


def require_intact(folder: Path, files: Collection[str] = ()) -> IntegrityCheck:
    """Verify the episode.

    Raises DamagedError if a file differs from its digest, or damage found earlier is unresolved.
    """
    verdict = verify_episode(folder, files)
    if verdict.state in ("sound", "unsealed") and (damage := known_damage(verdict)):
        verdict = IntegrityCheck(folder, "damaged", damage, verdict.bytes, verdict.seal)
    if verdict.state == "damaged":
        raise DamagedError(verdict)
    return verdict


def files_here(folder: Path) -> tuple[str, ...]:
    """Return the files of a closed episode that are not in the lab's store alone; () if none is there alone.

    The result is the argument `files` of a check that needs no videos. Raises RecordingError if the outcome or the
    index cannot be read.
    """
    stored = {name for name in stored_files(folder) if not (folder / name).exists()}
    return (
        tuple(name for name in read_outcome(folder).get(DIGESTS, ()) if name not in stored) if stored else ()
    )


def episodes_in(path: Path) -> list[Path]:
    """Return the folders of the episodes at `path`, which is one of three.

    If `path` is itself the folder of an episode, this folder is returned. Otherwise the episode folders in its
    subfolder `episodes` are returned, or those in `path` if there is no such subfolder.

    Raises RecordingError if there are none.
    """
    if not path.is_dir():
        raise RecordingError(f"{path} is no folder")
    if _is_episode(path):
        return [path]
    root = path / "episodes" if (path / "episodes").is_dir() else path
    folders = [folder for folder in sorted(root.iterdir()) if _is_episode(folder)]
    if not folders:
        raise RecordingError(f"{path} is no episode, and holds none: there is no {MANIFEST} in it")
    return folders


def _is_episode(folder: Path) -> bool:
    return any((folder / name).is_file() for name in (MANIFEST, OUTCOME, OUTCOME_COPY))


def _damage(path: Path, digest: FileDigest, manifest: Mapping[str, object]) -> Damage | None:
    try:
        with open(path, "rb") as file:
            if hashlib.file_digest(file, "sha256").hexdigest() == digest["sha256"]:
                return None
            return _located(path.name, file, digest, _rate(path.name, manifest))
    except FileNotFoundError:
        require_not_stored(path)
        return Damage(path.name, "is absent")
    except IsADirectoryError:
        return Damage(path.name, "is a folder")
    except OSError as error:
        if error.errno == errno.EIO:  # a failing disk is damage; other errors can be corrected
            return Damage(path.name, "cannot be read: the disk fails")
        raise disk_error("verifying", path, error) from error


def _located(name: str, file: BinaryIO, digest: FileDigest, rate: float | None) -> Damage:
    """Return the damage of a file, with the rows of its changed pieces; a changed header makes all rows doubtful."""
    size = file.seek(0, os.SEEK_END)
    description = (
        "is changed" if size == digest["bytes"] else f"has {size} bytes, was recorded with {digest['bytes']}"
    )
    file.seek(0)
    spans: list[tuple[int, int]] = []
    end = rows = 0
    for piece in digest["pieces"]:
        first, begin = rows, end
        end, rows, expected = _piece(piece)
        if hashlib.sha256(file.read(end - begin)).hexdigest() == expected:
            continue
        if rows > first:
            spans = _joined(spans, first, rows - 1)
        elif begin == 0:
            last = _piece(digest["pieces"][-1])[1]
            spans = [(0, last - 1)] if last else []
            break
    times = tuple((first / rate, (last + 1) / rate) for first, last in spans) if rate else ()
    return Damage(name, description, tuple(spans), times)


def _piece(text: str) -> tuple[int, int, str]:
    end, rows, digest = text.split()
    return int(end), int(rows), digest


def _joined(spans: list[tuple[int, int]], first: int, last: int) -> list[tuple[int, int]]:
    if spans and spans[-1][1] == first - 1:
        return [*spans[:-1], (spans[-1][0], last)]
    return [*spans, (first, last)]


def _manifest(folder: Path) -> Mapping[str, object]:
    """Return the manifest, which is needed only for times; {} if it is unreadable.

    An unreadable manifest is reported by the comparison with its digest.
    """
    try:
        return read_json(folder / MANIFEST)
    except RecordingError:
        return {}


def _rate(name: str, manifest: Mapping[str, object]) -> float | None:
    """Return the rows per second of the file `name`; None if its rows have no rate."""
    key = "control_rate" if name == "ticks.arrow" else "fps"
    timed = name.endswith(".mp4") or name.startswith(("rows.", "ticks."))
    value = manifest.get(key) if timed else None
    return float(value) if isinstance(value, int | float) and value > 0 else None
