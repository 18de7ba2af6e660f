"""Zip archive of failure clips with their table, generated while it is sent, without temporary files."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator
from typing import Any

from evaweb.blinding.visibility import Visibility, code_of
from evaweb.core.errors import EvaError
from evaweb.core.object_stores import StoreError
from evaweb.core.tabular_export import iter_csv
from evaweb.episodes.videos import video_file
from evaweb.trials.clips import clip_of
from evaweb.trials.gallery import COLUMNS, FailureFilters, failed_list, failure_trials, row_of
from evaweb.trials.models import Trial
from runtime.datasets.remux import cut
from runtime.recording.files import RecordingError

MOST = 500  # clips per archive
_ARCHIVE_COLUMNS = (*COLUMNS, "file", "file_begin_s", "why_no_file")
_TABLE = "failures.csv"


def require_few(filters: FailureFilters, sight: Visibility) -> None:
    """Raise EvaError if the filters are invalid or match more trials than an archive may have."""
    count = failed_list(filters, sight).count()
    if count > MOST:
        raise EvaError(f"{count} failed trials; allowed in one archive: at most {MOST}. Narrow the filters")


def clip_archive(filters: FailureFilters, sight: Visibility, root: str) -> Iterator[bytes]:
    """Yield a zip with a video per clip, named by trial and code, and the table; holds one clip in memory."""
    written = _Written()
    rows: list[dict[str, Any]] = []
    with zipfile.ZipFile(written, "w", zipfile.ZIP_STORED) as packed:  # videos are compressed already
        for page in failure_trials(filters, sight):
            for trial in page[: MOST - len(rows)]:  # more may have failed since the count
                content, values = _clip(trial)
                rows.append(row_of(trial, sight, root) | values)
                if content:
                    packed.writestr(values["file"], content)
                yield written.taken()
        packed.writestr(_TABLE, "".join(iter_csv(_ARCHIVE_COLUMNS, [rows])), zipfile.ZIP_DEFLATED)
    yield written.taken()


def _clip(trial: Trial) -> tuple[bytes, dict[str, Any]]:
    """Return the trial's clip as a video, and the values that describe the clip in the table of the archive.

    The video is b"" if there is none; the values then say why.
    """
    values = dict.fromkeys(("file", "why_no_file"), "") | {"file_begin_s": None}
    clip, episode = clip_of(trial), trial.episode
    if clip is None or episode is None:
        return b"", values | {"why_no_file": "it has no pictures"}
    try:
        video = video_file(episode.uuid, episode.cameras[0])
    except StoreError as error:
        return b"", values | {"why_no_file": str(error)}
    if not video.is_file():
        return b"", values | {"why_no_file": "its video is not prepared"}
    target = io.BytesIO()
    try:
        begin = cut(video, target, clip.begin, clip.end)
    except RecordingError:
        return b"", values | {"why_no_file": "its video cannot be read"}
    name = "-".join(filter(None, (f"trial-{trial.pk}", code_of(trial))))
    return target.getvalue(), values | {"file": f"clips/{name}.mp4", "file_begin_s": round(begin, 3)}


class _Written(io.RawIOBase):
    """Write-only sequential file; `taken` returns and removes the content written so far."""

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
