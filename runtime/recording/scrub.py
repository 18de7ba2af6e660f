"""Whether a recording is still what was recorded: every file against the digests in its outcome."""

from __future__ import annotations

import errno
import hashlib
import os
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Literal

from runtime.errors import RecordingError
from runtime.recording.digests import FileDigest
from runtime.recording.files import disk_fault, read_document
from runtime.recording.reader import open_episode
from runtime.recording.sealing import DIGESTS, MANIFEST, OUTCOME, read_outcome

UNSEALED = (
    "it is from before recordings had digests: nobody can say whether its files are as they were written"
)

State = Literal["sound", "damaged", "unsealed", "open"]


@dataclass(frozen=True, slots=True)
class Damage:
    """What is wrong with one file of an episode, and in which rows; of events.jsonl in which lines."""

    file: str
    what: str
    rows: tuple[tuple[int, int], ...] = ()  # first and last, both included
    times: tuple[
        tuple[float, float], ...
    ] = ()  # of these rows [s since the episode began], where that is known

    @property
    def text(self) -> str:
        """For a person."""
        unit = "lines" if self.file.endswith(".jsonl") else "rows"
        spans = [f"{first} to {last}" for first, last in self.rows]
        times = [f"{first:.2f} to {last:.2f}" for first, last in self.times]
        where = f", {unit} {', '.join(spans)}" if spans else ""
        return f"{self.file} {self.what}{where}" + (f" ({', '.join(times)} s)" if times else "")


@dataclass(frozen=True, slots=True)
class Verdict:
    """Of one episode. "unsealed": it has no digests. "open": it is being recorded, or wants repair."""

    path: Path
    state: State
    damage: tuple[Damage, ...] = ()
    bytes: int = 0  # that were read

    @property
    def text(self) -> str:
        """For a person."""
        said = {
            "sound": "every file is as it was recorded",
            "unsealed": UNSEALED,
            "open": "it has no outcome: it is being recorded, or wants repair",
            "damaged": "; ".join(one.text for one in self.damage),
        }
        return said[self.state]

    def document(self) -> dict[str, Any]:
        """As JSON."""
        damage = [
            {
                "file": one.file,
                "what": one.what,
                "rows": [list(span) for span in one.rows],
                "times": [list(span) for span in one.times],
                "text": one.text,
            }
            for one in self.damage
        ]
        return {"episode": self.path.name, "state": self.state, "bytes": self.bytes, "damage": damage}


class DamagedError(RecordingError):
    """A recording is not what was recorded."""

    def __init__(self, verdict: Verdict) -> None:
        self.verdict = verdict
        super().__init__(
            f"{verdict.path} is damaged: {verdict.text}. It is left as it is and never published; bring its files "
            "back from a copy"
        )


def verify(folder: Path, files: Collection[str] = ()) -> Verdict:
    """Read the files of the episode in `folder`, all or `files`; RecordingError where it is none, or closed to us."""
    if not (folder / OUTCOME).exists():
        if not (folder / MANIFEST).exists():
            raise RecordingError(f"{folder} is no episode: there is no {MANIFEST} in it")
        return Verdict(folder, "open")
    try:
        outcome = read_outcome(folder)
    except RecordingError as error:
        return Verdict(folder, "damaged", (Damage(OUTCOME, f"is damaged: {error}"),))
    if DIGESTS not in outcome:
        return Verdict(folder, "unsealed") if files else _unsealed(folder)
    manifest = _manifest(folder)
    digests = {name: told for name, told in outcome[DIGESTS].items() if not files or name in files}
    found = [_damage(folder / name, digest, manifest) for name, digest in digests.items()]
    damage = tuple(one for one in found if one is not None)
    size = sum(digest["bytes"] for digest in digests.values())
    return Verdict(folder, "damaged" if damage else "sound", damage, size)


def _unsealed(folder: Path) -> Verdict:
    """Without digests only what cannot be read at all is known to be damaged."""
    try:
        open_episode(folder)
    except RecordingError as error:
        return Verdict(folder, "damaged", (Damage(OUTCOME, f"has no digests, and {error}"),))
    return Verdict(folder, "unsealed")


def require_sound(folder: Path, files: Collection[str] = ()) -> Verdict:
    """As `verify`; DamagedError where a file is not what was recorded."""
    verdict = verify(folder, files)
    if verdict.state == "damaged":
        raise DamagedError(verdict)
    return verdict


def episodes_in(path: Path) -> list[Path]:
    """The folders of episodes that `path` is, or has in it or in its folder `episodes`; RecordingError for none."""
    if not path.is_dir():
        raise RecordingError(f"{path} is no folder")
    if _is_episode(path):
        return [path]
    root = path / "episodes" if (path / "episodes").is_dir() else path
    found = [folder for folder in sorted(root.iterdir()) if _is_episode(folder)]
    if not found:
        raise RecordingError(f"{path} is no episode, and holds none: there is no {MANIFEST} in it")
    return found


def _is_episode(folder: Path) -> bool:
    return any((folder / name).is_file() for name in (MANIFEST, OUTCOME))


def _damage(path: Path, digest: FileDigest, manifest: Mapping[str, object]) -> Damage | None:
    try:
        with open(path, "rb") as file:
            if hashlib.file_digest(file, "sha256").hexdigest() == digest["sha256"]:
                return None
            return _located(path.name, file, digest, _rate(path.name, manifest))
    except FileNotFoundError:
        return Damage(path.name, "is absent")
    except IsADirectoryError:
        return Damage(path.name, "is a folder")
    except OSError as error:
        if error.errno == errno.EIO:  # of the disk itself; any other is ours to mend
            return Damage(path.name, "cannot be read: the disk fails")
        raise disk_fault("verifying", path, error) from error


def _located(name: str, file: BinaryIO, digest: FileDigest, rate: float | None) -> Damage:
    """Which pieces of the file are others; of a table or video whose header is, every row is in doubt."""
    size = file.seek(0, os.SEEK_END)
    what = (
        "is changed" if size == digest["bytes"] else f"has {size} bytes, was recorded with {digest['bytes']}"
    )
    file.seek(0)
    spans: list[tuple[int, int]] = []
    end = rows = 0
    for piece in digest["pieces"]:
        first, begin = rows, end
        end, rows, wanted = _piece(piece)
        if hashlib.sha256(file.read(end - begin)).hexdigest() == wanted:
            continue
        if rows > first:
            spans = _joined(spans, first, rows - 1)
        elif begin == 0:
            last = _piece(digest["pieces"][-1])[1]
            spans = [(0, last - 1)] if last else []
            break
    times = tuple((first / rate, (last + 1) / rate) for first, last in spans) if rate else ()
    return Damage(name, what, tuple(spans), times)


def _piece(text: str) -> tuple[int, int, str]:
    end, rows, digest = text.split()
    return int(end), int(rows), digest


def _joined(spans: list[tuple[int, int]], first: int, last: int) -> list[tuple[int, int]]:
    if spans and spans[-1][1] == first - 1:
        return [*spans[:-1], (spans[-1][0], last)]
    return [*spans, (first, last)]


def _manifest(folder: Path) -> Mapping[str, object]:
    """For times alone: one that cannot be read is named by its digest."""
    try:
        return read_document(folder / MANIFEST)
    except RecordingError:
        return {}


def _rate(name: str, manifest: Mapping[str, object]) -> float | None:
    """Rows of that file per second; None where they have no rate."""
    key = "control_rate" if name == "ticks.arrow" else "fps"
    timed = name.endswith(".mp4") or name.startswith(("rows.", "ticks."))
    value = manifest.get(key) if timed else None
    return float(value) if isinstance(value, int | float) and value > 0 else None
