"""Reference pictures of positions in files that labs exchange: which they are in the TOML, they themselves beside it.

    [[reference]]  scene, position, station, camera, picture (the SHA-256 of the JPEG, and its name), regions

An archive (zip) has the TOML and pictures/<SHA-256>.jpg. What cameras show at all is of one lab's benches: that stays.
"""

from __future__ import annotations

import hashlib
import io
import re
import zipfile
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from django.contrib.auth.models import User

from evaweb.errors import EvaError, NotFound
from evaweb.plans import pictures
from evaweb.plans import regions as drawing
from evaweb.plans.models import Reference
from evaweb.stations.models import Station
from evaweb.trials.models import Position, Scene

LARGEST_TEXT = 2_000_000  # bytes of the TOML
LARGEST_PICTURE = 10_000_000
LARGEST = 400_000_000  # bytes of a file that is imported, and of all that is packed in it
_MOST = 20_000  # pictures
_PICTURE = re.compile(r"pictures/([0-9a-f]{64})\.jpg")


# --- out ---------------------------------------------------------------------------------------------------


def reference_tables(scenes: Iterable[Scene]) -> list[dict[str, Any]]:
    """The newest of each camera at each position of these."""
    rows = Reference.objects.filter(position__scene__in=list(scenes)).select_related(
        "position__scene", "station"
    )
    newest = {(row.position_id, row.station_id, row.camera): row for row in rows.order_by("pk")}
    found = [
        {
            "scene": row.position.scene.name,
            "position": row.position.number,
            "station": row.station.name,
            "camera": row.camera,
            "picture": row.picture,
            **({"regions": row.regions} if row.regions else {}),
        }
        for row in newest.values()
        if row.position is not None
    ]
    return sorted(found, key=lambda row: (row["scene"], row["position"], row["station"], row["camera"]))


def packed(text: str, name: str, references: Iterable[Mapping[str, Any]]) -> bytes:
    """An archive of the TOML, as `name`, with those of the pictures that are on this disk."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, text)
        for picture in sorted({str(row["picture"]) for row in references}):
            try:
                jpeg = pictures.kept(picture)
            except NotFound:
                continue  # whoever imports the archive is told which it has not
            archive.writestr(f"pictures/{picture}.jpg", jpeg, zipfile.ZIP_STORED)
    return content.getvalue()


# --- in ----------------------------------------------------------------------------------------------------


def unpacked(content: bytes) -> tuple[str, dict[str, bytes]]:
    """The TOML of a file that is TOML or an archive, and the pictures by name; EvaError says what is wrong with it."""
    if not content.startswith(b"PK"):
        return _text(content, "the file"), {}
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            return _of(archive)
    except (zipfile.BadZipFile, zipfile.LargeZipFile, NotImplementedError, RuntimeError) as error:
        raise EvaError(f"this archive cannot be read: {error}") from None


def _of(archive: zipfile.ZipFile) -> tuple[str, dict[str, bytes]]:
    entries = [entry for entry in archive.infolist() if not entry.is_dir()]
    texts = [entry for entry in entries if entry.filename.endswith(".toml") and "/" not in entry.filename]
    if len(texts) != 1:
        raise EvaError(f"the archive has {len(texts)} TOML files at its top; allowed: 1")
    others = [entry for entry in entries if entry is not texts[0]]
    strange = next((entry for entry in others if not _PICTURE.fullmatch(entry.filename)), None)
    if strange is not None:
        raise EvaError(f"the archive has {strange.filename!r:.80}; allowed: one TOML, pictures/<SHA-256>.jpg")
    if len(others) > _MOST or sum(entry.file_size for entry in entries) > LARGEST:
        raise EvaError(
            f"the archive has {len(others)} pictures; allowed: {_MOST}, and {LARGEST} bytes in all"
        )
    found = {}
    for entry in others:
        jpeg = _read(archive, entry, LARGEST_PICTURE)
        name = entry.filename.removeprefix("pictures/").removesuffix(".jpg")
        if hashlib.sha256(jpeg).hexdigest() != name:
            raise EvaError(f"{entry.filename}: its bytes have another SHA-256 than its name says")
        try:
            pictures.match(jpeg, jpeg)
        except EvaError as error:
            raise EvaError(f"{entry.filename}: {error}") from None
        found[name] = jpeg
    return _text(_read(archive, texts[0], LARGEST_TEXT), texts[0].filename), found


def _read(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, most: int) -> bytes:
    with archive.open(entry) as file:  # what an entry says of its size may be wrong
        content = file.read(most + 1)
    if len(content) > most:
        raise EvaError(f"{entry.filename} has more than {most} bytes, which is the most that is allowed")
    return content


def _text(content: bytes, name: str) -> str:
    if len(content) > LARGEST_TEXT:
        raise EvaError(f"{name} has {len(content)} bytes; allowed: {LARGEST_TEXT}, or an archive")
    try:
        return content.decode()
    except UnicodeDecodeError as error:
        raise EvaError(f"{name} is not a text: {error}") from None


def take_references(rows: Sequence[Mapping[str, Any]], found: Mapping[str, bytes], user: User) -> list[str]:
    """Keep the pictures and make them references where this lab has none of its own; a line for each scene."""
    told: dict[str, Counter[str]] = {}
    for row in rows:
        told.setdefault(row["scene"], Counter())[_taken(row, found, user)] += 1
    return [
        f"reference pictures of scene {scene}: " + ", ".join(f"{n} {what}" for what, n in counts.items())
        for scene, counts in told.items()
    ]


def _taken(row: Mapping[str, Any], found: Mapping[str, bytes], user: User) -> str:
    position = Position.objects.filter(scene__name=row["scene"], number=row["position"]).first()
    if position is None:
        raise EvaError(f"reference: position {row['position']} of scene {row['scene']!r:.60} does not exist")
    station = Station.objects.filter(name=row["station"]).first()
    if station is None:
        return f"left out, for there is no station {row['station']}"
    key = {"station": station, "position": position, "camera": row["camera"]}
    ours = Reference.objects.filter(**key).first()
    if ours is not None and (ours.picture, ours.regions) != (row["picture"], row["regions"]):
        return "left out, for this lab has its own"
    jpeg = found.get(row["picture"])
    if ours is not None:
        if jpeg is not None:
            pictures.keep(jpeg)  # its file may have been lost
        return "the same"
    if jpeg is None and not pictures.is_kept(row["picture"]):
        return "left out, for the file has not their pictures: import the archive"
    drawing.check_sizes(drawing.regions_of(row["regions"]), jpeg or pictures.kept(row["picture"]))
    name = pictures.keep(jpeg) if jpeg else row["picture"]
    Reference.objects.create(**key, picture=name, regions=row["regions"], by=user)
    return "new"
