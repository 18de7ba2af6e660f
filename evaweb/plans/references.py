"""Exchange of reference pictures between labs: table in the TOML, picture files in an archive.

    [[reference]]  scene, position, station, camera, picture (the SHA-256 of the JPEG, and its name), regions

An archive (zip) contains the TOML and pictures/<SHA-256>.jpg. References of cameras without a position belong to one
lab's benches and are not exported.
"""

from __future__ import annotations

import hashlib
import io
import lzma
import re
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from django.contrib.auth.models import User

from evaweb.core.errors import EvaError, NotFound
from evaweb.plans import image_store
from evaweb.plans import region_matching as drawing
from evaweb.plans.models import Reference
from evaweb.stations.models import Station
from evaweb.trials.models import Position, Scene
from runtime.core.sentences import Pattern

_THIS_ARCHIVE_CANNOT_READ = Pattern(
    "plans.references.this_archive_cannot_read",
    "this archive cannot be read: {error}",
)
_ARCHIVE_HAS_TOML_FILES_AT = Pattern(
    "plans.references.archive_has_toml_files_at",
    "the archive has {count} TOML files at its top; allowed: 1",
)
_ARCHIVE_HAS_ALLOWED_ONE_TOML = Pattern(
    "plans.references.archive_has_allowed_one_toml",
    "the archive has {filename!r:.80}; allowed: one TOML, pictures/<SHA-256>.jpg",
)
_ARCHIVE_HAS_PICTURES_ALLOWED_BYTES = Pattern(
    "plans.references.archive_has_pictures_allowed_bytes",
    "the archive has {count} pictures; allowed: {most}, and {largest} bytes in all",
)
_BYTES_HAVE_ANOTHER_SHA_256 = Pattern(
    "plans.references.bytes_have_another_sha_256",
    "{filename}: its bytes have another SHA-256 than its name says",
)
_HAS_MORE_THAN_BYTES_WHICH = Pattern(
    "plans.references.has_more_than_bytes_which",
    "{filename} has more than {most} bytes, which is the most that is allowed",
)
_HAS_BYTES_ALLOWED_ARCHIVE = Pattern(
    "plans.references.has_bytes_allowed_archive",
    "{name} has {count} bytes; allowed: {largest_text}, or an archive",
)
_NOT_TEXT = Pattern("plans.references.not_text", "{name} is not a text: {error}")
_REFERENCE_POSITION_SCENE_DOES_NOT = Pattern(
    "plans.references.reference_position_scene_does_not",
    "reference: position {position} of scene {scene!r:.60} does not exist",
)

LARGEST_TEXT = 2_000_000  # size of the TOML [bytes]
LARGEST_PICTURE = 10_000_000
LARGEST = 400_000_000  # size of an imported file, and of its unpacked content [bytes]
_MOST = 20_000  # pictures in an archive
_PICTURE = re.compile(r"pictures/([0-9a-f]{64})\.jpg")


# --- out ---------------------------------------------------------------------------------------------------


def reference_tables(scenes: Iterable[Scene]) -> list[dict[str, Any]]:
    """Return the newest reference of each camera at each position of these scenes."""
    rows = Reference.objects.filter(position__scene__in=list(scenes)).select_related(
        "position__scene", "station"
    )
    newest = {(row.position_id, row.station_id, row.camera): row for row in rows.order_by("pk")}
    tables = [
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
    return sorted(tables, key=lambda row: (row["scene"], row["position"], row["station"], row["camera"]))


def packed(text: str, name: str, references: Iterable[Mapping[str, Any]]) -> bytes:
    """Return an archive with the TOML as `name`, and the referenced pictures that are on this disk."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, text)
        for picture in sorted({str(row["picture"]) for row in references}):
            try:
                jpeg = image_store.load_image(picture)
            except NotFound:
                continue  # the import reports missing pictures
            archive.writestr(f"pictures/{picture}.jpg", jpeg, zipfile.ZIP_STORED)
    return content.getvalue()


_DAMAGED = (  # exceptions of zip and its compression methods for invalid data
    *(
        zipfile.BadZipFile,
        zipfile.LargeZipFile,
        NotImplementedError,
        RuntimeError,
        EOFError,
        OSError,
        ValueError,
    ),
    *(zlib.error, lzma.LZMAError),
)

# --- in ----------------------------------------------------------------------------------------------------


def unpacked(content: bytes) -> tuple[str, dict[str, bytes]]:
    """Return text and pictures (by name) of a TOML file or archive. Raises: EvaError if it is invalid."""
    if not content.startswith(b"PK"):
        return _text(content, "the file"), {}
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            return _of(archive)
    except _DAMAGED as error:
        raise EvaError(_THIS_ARCHIVE_CANNOT_READ(error=error)) from None


def _of(archive: zipfile.ZipFile) -> tuple[str, dict[str, bytes]]:
    entries = [entry for entry in archive.infolist() if not entry.is_dir()]
    texts = [entry for entry in entries if entry.filename.endswith(".toml") and "/" not in entry.filename]
    if len(texts) != 1:
        raise EvaError(_ARCHIVE_HAS_TOML_FILES_AT(count=len(texts)))
    pictures = [entry for entry in entries if entry is not texts[0]]
    strange = next((entry for entry in pictures if not _PICTURE.fullmatch(entry.filename)), None)
    if strange is not None:
        raise EvaError(_ARCHIVE_HAS_ALLOWED_ONE_TOML(filename=strange.filename))
    if len(pictures) > _MOST or sum(entry.file_size for entry in entries) > LARGEST:
        raise EvaError(_ARCHIVE_HAS_PICTURES_ALLOWED_BYTES(count=len(pictures), most=_MOST, largest=LARGEST))
    jpegs = {}
    for entry in pictures:
        jpeg = _read(archive, entry, LARGEST_PICTURE)
        name = entry.filename.removeprefix("pictures/").removesuffix(".jpg")
        if hashlib.sha256(jpeg).hexdigest() != name:
            raise EvaError(_BYTES_HAVE_ANOTHER_SHA_256(filename=entry.filename))
        try:
            image_store.image_match(jpeg, jpeg)
        except EvaError as error:
            raise EvaError(f"{entry.filename}: {error}") from None
        jpegs[name] = jpeg
    return _text(_read(archive, texts[0], LARGEST_TEXT), texts[0].filename), jpegs


def _read(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, most: int) -> bytes:
    with archive.open(entry) as file:  # the declared size of an entry may be wrong
        content = file.read(most + 1)
    if len(content) > most:
        raise EvaError(_HAS_MORE_THAN_BYTES_WHICH(filename=entry.filename, most=most))
    return content


def _text(content: bytes, name: str) -> str:
    if len(content) > LARGEST_TEXT:
        raise EvaError(_HAS_BYTES_ALLOWED_ARCHIVE(name=name, count=len(content), largest_text=LARGEST_TEXT))
    try:
        return content.decode()
    except UnicodeDecodeError as error:
        raise EvaError(_NOT_TEXT(name=name, error=error)) from None


def import_references(rows: Sequence[Mapping[str, Any]], found: Mapping[str, bytes], user: User) -> list[str]:
    """Store the pictures, and make each the reference of its station, position and camera.

    A reference that this lab already has there is kept. Return a message per scene.
    """
    by_scene: dict[str, Counter[str]] = {}
    for row in rows:
        by_scene.setdefault(row["scene"], Counter())[_taken(row, found, user)] += 1
    return [
        f"reference pictures of scene {scene}: " + ", ".join(f"{n} {change}" for change, n in counts.items())
        for scene, counts in by_scene.items()
    ]


def _taken(row: Mapping[str, Any], pictures: Mapping[str, bytes], user: User) -> str:
    position = Position.objects.filter(scene__name=row["scene"], number=row["position"]).first()
    if position is None:
        raise EvaError(_REFERENCE_POSITION_SCENE_DOES_NOT(position=row["position"], scene=row["scene"]))
    station = Station.objects.filter(name=row["station"]).first()
    if station is None:
        return f"left out, because there is no station {row['station']}"
    key = {"station": station, "position": position, "camera": row["camera"]}
    existing = Reference.objects.filter(**key).first()
    if existing is not None and (existing.picture, existing.regions) != (row["picture"], row["regions"]):
        return "left out, because this lab has its own"
    jpeg = pictures.get(row["picture"])
    if existing is not None:
        if jpeg is not None:
            image_store.store_image(jpeg)  # restores a lost file
        return "the same"
    if jpeg is None and not image_store.has_image(row["picture"]):
        return "left out, because the file lacks their pictures: import the archive"
    drawing.check_sizes(drawing.regions_of(row["regions"]), jpeg or image_store.load_image(row["picture"]))
    name = image_store.store_image(jpeg) if jpeg else row["picture"]
    Reference.objects.create(**key, picture=name, regions=row["regions"], by=user)
    return "new"
