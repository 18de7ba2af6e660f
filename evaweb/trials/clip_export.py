"""Clips of failed trials and their table as one archive, made while it is sent: no file of it is on the disk."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator
from typing import Any

from evaweb.blinding import Visibility, code_of
from evaweb.episodes.videos import video_file
from evaweb.errors import EvaError
from evaweb.object_stores import StoreError
from evaweb.tabular_export import iter_csv
from evaweb.trials.clips import clip_of
from evaweb.trials.gallery import COLUMNS, FailureFilters, failed_list, failure_trials, row_of
from evaweb.trials.models import Trial
from runtime.datasets.remux import cut
from runtime.recording.files import RecordingError

MOST = 500  # clips of an archive, each a few seconds
_ARCHIVE_COLUMNS = (*COLUMNS, "file", "file_begin_s", "why_no_file")
_TABLE = "failures.csv"


def require_few(filters: FailureFilters, sight: Visibility) -> None:
    """EvaError where the filters are wrong, or mean more trials than an archive holds."""
    count = failed_list(filters, sight).count()
    if count > MOST:
        raise EvaError(f"{count} failed trials; allowed in one archive: at most {MOST}. Narrow the filters")


def clip_archive(filters: FailureFilters, sight: Visibility, root: str) -> Iterator[bytes]:
    """A zip with a video per clip, named by trial and code, and the table of all; one clip in memory at a time."""
    written = _Written()
    rows: list[dict[str, Any]] = []
    with zipfile.ZipFile(written, "w", zipfile.ZIP_STORED) as packed:  # videos are as small as they get
        for page in failure_trials(filters, sight):
            for trial in page[: MOST - len(rows)]:  # some may have failed since they were counted
                content, told = _clip(trial)
                rows.append(row_of(trial, sight, root) | told)
                if content:
                    packed.writestr(told["file"], content)
                yield written.taken()
        packed.writestr(_TABLE, "".join(iter_csv(_ARCHIVE_COLUMNS, [rows])), zipfile.ZIP_DEFLATED)
    yield written.taken()


def _clip(trial: Trial) -> tuple[bytes, dict[str, Any]]:
    """The clip as a video, and what the table says of it; no bytes where there is none."""
    told = dict.fromkeys(("file", "why_no_file"), "") | {"file_begin_s": None}
    clip, episode = clip_of(trial), trial.episode
    if clip is None or episode is None:
        return b"", told | {"why_no_file": "it has no pictures"}
    try:
        video = video_file(episode.uuid, episode.cameras[0])
    except StoreError as error:
        return b"", told | {"why_no_file": str(error)}
    if not video.is_file():
        return b"", told | {"why_no_file": "its video is not prepared"}
    target = io.BytesIO()
    try:
        begin = cut(video, target, clip.begin, clip.end)
    except RecordingError:
        return b"", told | {"why_no_file": "its video cannot be read"}
    name = "-".join(filter(None, (f"trial-{trial.pk}", code_of(trial))))
    return target.getvalue(), told | {"file": f"clips/{name}.mp4", "file_begin_s": round(begin, 3)}


class _Written(io.RawIOBase):
    """A file that only goes forward, and gives away what was written to it."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        self._parts.append(bytes(data))
        return len(data)

    def taken(self) -> bytes:
        parts, self._parts = self._parts, []
        return b"".join(parts)
