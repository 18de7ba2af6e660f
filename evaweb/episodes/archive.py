"""Camera files of closed recordings in the lab's store: moved there, brought back when a job reads them, removed again.

`archived/UUID.json` names the files and their digests. It is written after the store has all of them, and before one is
removed here; what it names is in the store, whether or not it is here too. Nothing else of a recording is changed.
"""

from __future__ import annotations

import logging
import os
import shutil
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from uuid import UUID

from django.conf import settings

from evaweb.core.errors import Conflict
from evaweb.core.object_stores import StoreError, compared, fetch, required_store, the_store
from evaweb.episodes.folders import archive_folder, data_dir, journal_folder
from evaweb.episodes.manifest import CLOSED
from evaweb.episodes.models import Episode
from evaweb.jobs.kinds import JobContext
from evaweb.jobs.models import Hold, JobStatus
from runtime.core.durable_files import sync_folder
from runtime.core.sentences import Pattern, fixed
from runtime.recording.archive_index import CAMERA_FILES, index_file, stored_files, write_index
from runtime.recording.base import IMPORTED
from runtime.recording.files import RecordingError, disk_error, exclusive
from runtime.recording.outcome_seal import DIGESTS, read_outcome
from runtime.recording.scrub import require_intact

log = logging.getLogger(__name__)

UNUSED_S = 3600.0  # time after its last use at which a video that was brought back is removed again
_IN_USE_S = 600.0  # the same if there are more of them than EVA_CACHE_BYTES
_AT_ONCE = 5
_TYPE = "video/mp4"
_HERE = "here"  # folder of archived/ with one empty file per recording that was brought back; its time is the last use
_DRAFTS = ".draft*"  # of a fetch that was killed

_NOT_ARCHIVED = Pattern("episodes.archive.not_archived", "episode {uuid} stays as it is: {why}")
_UNKNOWN = fixed("episodes.archive.unknown", "it does not exist in this lab")
_NOT_CLOSED = Pattern("episodes.archive.not_closed", "it is {status}")
_AWAY = fixed("episodes.archive.away", "it is on its station's computer")
_DAMAGED = fixed("episodes.archive.damaged", "it is damaged")
_IMPORTED = fixed("episodes.archive.imported", "it was imported: its dataset holds its videos")
_OTHER_OUTCOME = fixed(
    "episodes.archive.other_outcome", "its outcome is not the one with which it was closed"
)
_NO_VIDEOS = fixed("episodes.archive.no_videos", "it has no videos")
_OTHER_FILES = Pattern(
    "episodes.archive.other_files",
    "the files of episode {uuid} stay here: {name} is in the store with another SHA-256 than its outcome says",
)
_NO_ROOM = Pattern(
    "episodes.archive.no_room",
    "the recorded videos of episode {uuid} are in the store, and there is no room for them here: {wanted} bytes "
    "wanted, {free} bytes free, of which EVA_RESERVE_GB stays free",
)


class NotArchived(Conflict):
    """Error if the camera files of a recording may not be moved to the store."""


def archived_files(uuid: UUID) -> dict[str, str]:
    """Return the SHA-256 of each camera file that is in the store, by name; {} if none is.

    Raises: RecordingError if the index cannot be read.
    """
    return stored_files(journal_folder(uuid))


def archived_at(uuid: UUID) -> datetime | None:
    """Return since when the camera files of a recording are in the store, None if they are not."""
    try:
        return datetime.fromtimestamp(index_file(data_dir(), str(uuid)).stat().st_mtime, UTC)
    except FileNotFoundError:
        return None


def lock_recording(work: JobContext, uuid: UUID, also: Collection[str] = ()) -> None:
    """Let the job hold the videos of a recording, and the names in `also`, until it ends or holds others.

    Jobs that read recorded videos, and those that move them, exclude each other.
    """
    if names := [*also, *_lock_names(uuid)]:
        work.hold(names)


def use_videos(work: JobContext, uuid: UUID, also: Collection[str] = ()) -> None:
    """Let the job hold the videos of a recording as `lock_recording` does, and bring back those that are absent.

    Raises: StoreError, RecordingError, as `bring_back`.
    """
    lock_recording(work, uuid, also)
    bring_back(uuid, work.report_progress)


def _lock_names(uuid: UUID) -> list[str]:
    return [f"episodes/{uuid}"] if the_store() is not None else []  # without a store nothing is moved


def why_not(episode: Episode) -> str:
    """Return why the camera files of a recording stay here, as far as its row shows it; "" if they may be moved."""
    if episode.status not in CLOSED:
        return _NOT_CLOSED(status=episode.get_status_display())
    if episode.away_since is not None:
        return _AWAY
    if episode.damage:
        return _DAMAGED
    if episode.kind == IMPORTED:
        return _IMPORTED
    return ""


# --- into the store ------------------------------------------------------------------------------------------


def put_away(uuid: UUID, report: Callable[[str], None] = lambda _: None, held: bool = False) -> int:
    """Move the camera files of a closed, sound recording to the store; return how many were removed here.

    It may be ended at any moment and run again. An index that exists is never changed. Unless the caller is the job
    that holds the recording (`held`), files that a job reads by then stay, as if they had been brought back for it.

    Raises:
        NotArchived: The recording may not be moved.
        DamagedError: A file of it is not what was recorded.
        RecordingError: It or its index cannot be read or written.
        StoreError: The store does not take or give a file, or gives another one.
    """
    episode = Episode.objects.filter(uuid=uuid).first()
    if episode is None:
        raise NotArchived(_NOT_ARCHIVED(uuid=uuid, why=_UNKNOWN))
    if why := why_not(episode):
        raise NotArchived(_NOT_ARCHIVED(uuid=uuid, why=why))
    store, folder = required_store(), journal_folder(uuid)
    files = archived_files(uuid)
    if not files:
        files = _sealed_files(episode, folder)
        for number, (name, digest) in enumerate(files.items(), 1):
            report(f"video {number} of {len(files)} into the store")
            if (stored := store.put(folder / name, _TYPE)) != digest:
                raise RecordingError(
                    f"{folder / name} changed while it was read: {stored}, sealed as {digest}"
                )
            compared(store, digest)
        write_index(data_dir(), str(uuid), files)
    elif any((folder / name).exists() for name in files):
        for digest in files.values():
            compared(store, digest)
    with exclusive(_mark(uuid).parent):
        if held or not is_in_use(uuid):
            removed = _remove(uuid, files)
        else:
            removed = 0
            _mark(uuid).touch()
    Episode.objects.filter(uuid=uuid).update(archived_at=archived_at(uuid))
    return removed


def _sealed_files(episode: Episode, folder: Path) -> dict[str, str]:
    """Return the digests of the camera files by the seal, after the whole recording was compared with it.

    Raises: NotArchived, RecordingError, DamagedError.
    """
    check = require_intact(folder)
    if check.state != "sound":
        raise NotArchived(_NOT_ARCHIVED(uuid=episode.uuid, why=check.text))
    if episode.seal and check.seal != episode.seal:
        raise NotArchived(_NOT_ARCHIVED(uuid=episode.uuid, why=_OTHER_OUTCOME))
    digests = read_outcome(folder)[DIGESTS]
    files = {name: entry["sha256"] for name, entry in digests.items() if name.endswith(CAMERA_FILES)}
    if not files:
        raise NotArchived(_NOT_ARCHIVED(uuid=episode.uuid, why=_NO_VIDEOS))
    return files


def _remove(uuid: UUID, files: dict[str, str]) -> int:
    """Remove local files that the store has, with drafts and the mark of their use; return the number of files.

    Raises: RecordingError if the disk refuses it, or if the index is of other files than those that were recorded.
    """
    folder, removed = journal_folder(uuid), 0
    recorded = (
        read_outcome(folder).get(DIGESTS, {}) if any((folder / name).exists() for name in files) else {}
    )
    for name in recorded.keys() & files.keys():
        if recorded[name]["sha256"] != files[name]:
            raise RecordingError(_OTHER_FILES(uuid=uuid, name=name))
    try:
        for name in files:
            if (folder / name).exists():
                (folder / name).unlink(missing_ok=True)
                removed += 1
        for draft in folder.glob(_DRAFTS):
            draft.unlink(missing_ok=True)
        if folder.is_dir():  # else somebody has removed the whole recording
            sync_folder(folder)
        _mark(uuid).unlink(missing_ok=True)
    except OSError as error:
        raise disk_error("removing what is in the store from", folder, error) from error
    return removed


# --- and back ------------------------------------------------------------------------------------------------


def bring_back(uuid: UUID, report: Callable[[str], None] = lambda _: None) -> int:
    """Bring every camera file that is absent from the store, and note that they are used; return how many were absent.

    A reader sees a whole file or none. Do nothing for a recording that is not in the store.

    Raises:
        StoreError: There is no store, it does not answer or gives another file, or there is no room here.
        RecordingError: The index cannot be read, or the disk refuses the files.
    """
    files, folder = archived_files(uuid), journal_folder(uuid)
    if not files or not folder.is_dir():
        return 0
    try:
        with exclusive(_mark(uuid).parent):  # what is here now stays
            _mark(uuid).touch()  # before the files: whatever was brought is removed again some day
            absent = {name: digest for name, digest in files.items() if not (folder / name).exists()}
        if absent:
            store = required_store()
            remove_unused(besides=uuid)
            _require_room(uuid, folder, absent)
            for number, (name, digest) in enumerate(absent.items(), 1):
                report(f"video {number} of {len(absent)} from the store")
                fetch(store, digest, folder / name)
                _mark(uuid).touch()
    except OSError as error:
        raise disk_error("bringing back", folder, error) from error
    return len(absent)


def bring_again(uuid: UUID, names: Collection[str]) -> bool:
    """Replace local copies of files that are in the store, because they were found changed; return True if any is.

    Raises: StoreError, RecordingError, as `bring_back`.
    """
    folder = journal_folder(uuid)
    files = {name: digest for name, digest in archived_files(uuid).items() if name in names}
    try:
        for name, digest in files.items():
            fetch(required_store(), digest, folder / name)
    except OSError as error:
        raise disk_error("bringing back", folder, error) from error
    return bool(files)


def remove_unused(now: float | None = None, besides: UUID | None = None) -> int:
    """Remove files that were brought back and not used for an hour, oldest first; return the number of recordings.

    While they have more than EVA_CACHE_BYTES, ten minutes are enough. Files that a running job reads stay, and so do
    those that the store does not give back as they were, or that the disk does not let go: these are looked at again
    after an hour. At most _AT_ONCE recordings are looked at per call.

    Args:
        now: Time [Unix s], None for the present.
        besides: Recording that is not counted, and stays.
    """
    if the_store() is None:
        return 0
    now = time.time() if now is None else now
    marks = sorted((used, uuid, _local_bytes(uuid)) for used, uuid in _marks() if uuid != besides)
    size, removed, tried = sum(own for _, _, own in marks), 0, 0
    for used, uuid, own in marks:
        enough = UNUSED_S if size <= settings.EVA_CACHE_BYTES else _IN_USE_S
        if now - used < enough or tried >= _AT_ONCE:
            break
        if is_in_use(uuid):
            continue
        tried += 1
        try:
            done = _remove_again(uuid, used)
        except (
            StoreError,
            RecordingError,
        ) as error:  # of this recording alone: it must not keep the others here
            log.warning("the videos of episode %s stay here: %s", uuid, error)
            with suppress(FileNotFoundError):  # another worker has removed them
                os.utime(_mark(uuid), (now, now))
            continue
        if done:
            size -= own
            removed += 1
    return removed


def _remove_again(uuid: UUID, used: float) -> bool:
    """Remove what was brought back after the store's copies were compared; return False if it is used again meanwhile.

    `used` is the time of its last use [Unix s]. Raises: StoreError, RecordingError.
    """
    store, files, folder = required_store(), archived_files(uuid), journal_folder(uuid)
    for name, digest in files.items():
        if (folder / name).exists():
            compared(store, digest)
    with exclusive(_mark(uuid).parent):
        if is_in_use(uuid) or (used, uuid) not in _marks():
            return False
        _remove(uuid, files)
    return True


def _require_room(uuid: UUID, folder: Path, absent: dict[str, str]) -> None:
    """Raise StoreError if the files would take the room that the lab keeps free for recordings."""
    try:
        digests = read_outcome(folder).get(DIGESTS, {})
    except RecordingError:
        digests = {}  # a damaged outcome is for the verification to find, which needs the files
    wanted = sum(int(digests[name]["bytes"]) for name in absent if name in digests)
    free = shutil.disk_usage(folder).free
    if free - wanted < settings.EVA_RESERVE_BYTES:
        raise StoreError(_NO_ROOM(uuid=uuid, wanted=wanted, free=free))


def is_in_use(uuid: UUID) -> bool:
    """Return True if a running job reads the videos of a recording, or moves them."""
    return Hold.objects.filter(what__in=_lock_names(uuid), job__status=JobStatus.RUNNING).exists()


def _mark(uuid: UUID) -> Path:
    return archive_folder() / _HERE / str(uuid)


def _marks() -> Iterator[tuple[float, UUID]]:
    """Yield (time of the last use [Unix s], uuid) of the recordings that were brought back."""
    for path in (archive_folder() / _HERE).glob("*"):
        try:
            yield path.stat().st_mtime, UUID(path.name)
        except (FileNotFoundError, ValueError):
            continue


def _local_bytes(uuid: UUID) -> int:
    size = 0
    for path in journal_folder(uuid).glob(f"*{CAMERA_FILES}"):
        with suppress(FileNotFoundError):  # another worker has removed it
            size += path.stat().st_size
    return size
