"""Writer of a bundle: all parts without secrets, the ends of logs, and a summary of its contents and omissions."""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from django.conf import settings
from django.db import Error
from django.utils import timezone

from evaweb.blinding.visibility import Visibility, visibility_for_user
from evaweb.core.errors import EvaError
from evaweb.lab.diagnosis import contents, summary
from evaweb.lab.diagnosis.scrubbing import Scrubber, known_secrets
from evaweb.stations.models import Station

LONGEST_LOG = 2_000_000  # [bytes] of the end of each log
LONGEST_LOGS = 24_000_000  # [bytes] of all logs together
LONGEST_PART = 8_000_000  # [characters] of any other file
Tell = Callable[[str], None]
Named = tuple[str, Any]


def write(path: Path, sight: Visibility, tell: Tell) -> list[str]:
    """Write the bundle to `path`, readable only by this account; return notes on what it omits.

    It contains only what `sight` allows. `tell` is called with each part that is being gathered. The file is written
    completely or not at all.
    """
    scrubber = Scrubber(known_secrets(), sight.names)
    notes: list[str] = []
    draft = path.with_name(f".{path.name}")  # fixed name: a repeated job overwrites an interrupted one
    try:
        descriptor = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        with os.fdopen(descriptor, "wb") as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as packed:
            _fill(packed, scrubber, sight, notes, tell)
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)
    return notes


def _fill(
    packed: zipfile.ZipFile, scrubber: Scrubber, visibility: Visibility, notes: list[str], tell: Tell
) -> None:
    parts: dict[str, Any] = {}
    written: list[tuple[str, int]] = []

    def put(name: str, text: str) -> None:
        if len(text) > LONGEST_PART:
            notes.append(f"{name}: cut after {LONGEST_PART:,} of {len(text):,} characters")
            text = text[:LONGEST_PART]
        packed.writestr(name, text)
        written.append((name, len(text.encode())))

    for name, content in _parts(visibility, notes, tell):
        parts[name] = scrubber.tree(content)
        put(name, json.dumps(parts[name], indent=1, default=str, ensure_ascii=False) + "\n")
    tell("logs")
    for name, text in _logs(visibility, notes):
        put(name, scrubber.text(text))
    title = f"EVA Web, diagnostic bundle of {timezone.localtime():%Y-%m-%d %H:%M %Z}"
    remarks = scrubber.tree(notes) or ["nothing was left out or cut"]
    sections = summary.sections(
        parts, written, [*remarks, "secrets: keys, passwords and tokens read (removed)"]
    )
    put("summary.txt", summary.as_text(title, sections))
    put("summary.html", summary.as_html(title, sections))


def _parts(visibility: Visibility, notes: list[str], tell: Tell) -> Iterator[Named]:
    if not visibility.hides_nothing:
        notes.append(f"logs, policies of deployments, and what tells of checkpoints: {visibility.plans}")
    tell("versions and settings")
    yield "versions.json", contents.versions()
    yield "settings.json", contents.lab_settings()
    tell("the machine")
    yield "machine.json", contents.machine()
    tell("database and jobs")
    yield from _guarded("the database", _of_database(visibility), notes)
    yield "programs.json", contents.programs(visibility)
    yield from _guarded("deployments", _deployments(visibility), notes)
    yield from _guarded("stations", _stations(visibility, notes, tell), notes)


def _of_database(visibility: Visibility) -> Iterator[Named]:
    yield "database.json", contents.database()
    yield "jobs.json", contents.jobs(visibility)


def _deployments(visibility: Visibility) -> Iterator[Named]:
    for name, tree in contents.deployment_files(visibility):
        yield f"deployments/{name}.json", tree


def _stations(visibility: Visibility, notes: list[str], tell: Tell) -> Iterator[Named]:
    for station in Station.objects.order_by("name"):
        tell(f"the station {station.name}")
        station_parts = contents.station_parts(station, visibility)
        named = ((f"stations/{station.name}/{part}.json", content) for part, content in station_parts)
        yield from _guarded(f"station {station.name}", named, notes)


def _guarded(label: str, parts: Iterator[Named], notes: list[str]) -> Iterator[Named]:
    """Yield the parts that can be gathered; errors become notes, because a diagnosed lab may be broken anywhere."""
    try:
        yield from parts
    except (Error, OSError, EvaError) as error:
        notes.append(f"{label} as far as it could not be read: {error}")


def _logs(visibility: Visibility, notes: list[str]) -> Iterator[tuple[str, str]]:
    """Yield (name, text) of each log file, where the text is the end of the file if the file is too long.

    A reader from whom anything is hidden by a blind plan gets no logs, because logs name checkpoints and servers. Each
    log that is cut short is mentioned in `notes`.
    """
    if not visibility.hides_nothing:
        return
    room = LONGEST_LOGS
    for path in contents.logs():
        size = path.stat().st_size
        length = min(size, LONGEST_LOG, room)
        room -= length
        if length < size:
            notes.append(f"logs/{path.name}: its last {length:,} of {size:,} bytes")
        if length == 0 and size:
            continue
        with path.open("rb") as file:
            file.seek(size - length)
            end = file.read(length)
        if length < size:  # not from within a line: the scrubber would not recognise half a secret
            end = end.partition(b"\n")[2]
        yield f"logs/{path.name}", end.decode("utf-8", "replace")


def visibility_for(user: Any) -> Visibility:
    """Return the visibility of a user; if the database does not answer, everything that a plan could hide is hidden."""
    try:
        return visibility_for_user(user)
    except Error as error:
        return Visibility(checkpoints=frozenset({0}), plans=f"who is blind cannot be read ({error})")


def folder(user: Any) -> Path:
    """Return the folder of a user's bundles, which only that user may download."""
    path = Path(settings.DATA_DIR) / "diagnosis" / str(user.pk)
    path.mkdir(mode=0o700, parents=True, exist_ok=True)
    return path
