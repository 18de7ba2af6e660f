"""Export of a plan's results as an RO-Crate: the report, videos if wanted, and metadata, in one zip.

The same records and the same options give the same bytes, as long as program and libraries are the same: files are
sorted, have one time, and the report states the time of the newest record instead of the present.
"""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO

from evaweb.core.errors import EvaError
from evaweb.core.object_stores import StoreError
from evaweb.episodes.videos import video_file
from evaweb.plans.models import Plan
from evaweb.results.crates.facts import crate_facts
from evaweb.results.crates.graph import PackedFile, crate_metadata, rocrate_library
from evaweb.results.crates.options import CrateOptions
from evaweb.results.reports.reporting import write_report
from evaweb.trials.models import TrialStatus
from runtime.core.sentences import Pattern

_VIDEOS_TOO_LARGE = Pattern(
    "results.crates.videos_too_large",
    "the videos have more than {most} bytes; allowed here: {most}. Leave them out, or write the crate with "
    "manage.py crates export",
)

METADATA = "ro-crate-metadata.json"
_TIME = (1980, 1, 1, 0, 0, 0)  # the earliest that a zip can state: one time for all files
_BLOCK = 1 << 20
_STORED = (".mp4", ".jpg")  # compressed already


@dataclass(frozen=True, slots=True)
class WrittenCrate:
    """Content of a crate that was written: number of files, of videos, and of videos that are not on this machine."""

    files: int
    videos: int
    absent: int


def write_crate(
    plan: Plan,
    options: CrateOptions,
    target: IO[bytes],
    *,
    most_pictures: int | None = None,
    most_videos: int | None = None,
) -> WrittenCrate:
    """Write the crate of a plan as a zip; whether its reader may see the results is checked by the caller.

    Args:
        plan: A plan that is frozen or later.
        options: What the exporter decides.
        target: Seekable file.
        most_pictures: Limit of bench images [bytes]; None for all.
        most_videos: Limit of videos [bytes]; None for all.

    Raises:
        EvaError: If the plan is a draft, rocrate is absent, or the videos exceed their limit.
    """
    rocrate_library()  # before the work is done
    facts = crate_facts(plan)
    videos, absent = _videos(plan, most_videos) if options.videos else ({}, 0)
    with TemporaryDirectory() as folder:
        report = Path(folder) / "report"
        write_report(plan, report, most_pictures=most_pictures, written_at=facts.recorded_at)
        sources = {path.relative_to(report).as_posix(): path for path in _files(report)} | videos
        with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as packed:
            files = [_add(packed, name, path) for name, path in sorted(sources.items())]
            remark = f"{absent} videos are left out: they are not on the lab's machine." if absent else ""
            metadata = crate_metadata(plan, facts, options, files, remark)
            text = json.dumps(metadata, indent=1, ensure_ascii=False) + "\n"
            packed.writestr(_entry(METADATA), text.encode())
    return WrittenCrate(len(files), len(videos), absent)


def _videos(plan: Plan, most: int | None) -> tuple[dict[str, Path], int]:
    """Return the videos of the trials that count by their path in the crate, and how many are not on this machine.

    Raises: EvaError once they exceed the limit, before the others are fetched from the store.
    """
    found, absent, size = {}, 0, 0
    rows = plan.handouts.filter(trial__status=TrialStatus.SCORED, trial__episode__isnull=False)
    for handout in rows.select_related("trial__episode").order_by("number"):
        trial = handout.trial
        for camera in trial.episode.cameras:
            try:
                path = video_file(trial.episode.uuid, camera)
            except StoreError:
                path = None
            if path is not None and path.is_file():
                found[f"videos/trial-{trial.pk}-{camera}.mp4"] = path
                size += path.stat().st_size
                if most is not None and size > most:
                    raise EvaError(_VIDEOS_TOO_LARGE(most=most))
            else:
                absent += 1
    return found, absent


def _files(folder: Path) -> Iterator[Path]:
    return (path for path in folder.rglob("*") if path.is_file())


def _entry(name: str) -> zipfile.ZipInfo:
    entry = zipfile.ZipInfo(name, _TIME)
    entry.create_system = 3  # Unix, wherever it is written
    entry.external_attr = 0o100644 << 16
    entry.compress_type = zipfile.ZIP_STORED if name.endswith(_STORED) else zipfile.ZIP_DEFLATED
    return entry


def _add(packed: zipfile.ZipFile, name: str, path: Path) -> PackedFile:
    entry, digest, size = _entry(name), hashlib.sha256(), 0
    entry.file_size = path.stat().st_size
    with path.open("rb") as source, packed.open(entry, "w") as file:
        while block := source.read(_BLOCK):
            file.write(block)
            digest.update(block)
            size += len(block)
    return PackedFile(name, size, digest.hexdigest())
