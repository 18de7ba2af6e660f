"""Episodes of stations on other computers: their owners, transfer progress, and rows on arrival."""

from __future__ import annotations

import logging
from uuid import UUID

from django.db import Error, close_old_connections

from evaweb.core.object_stores import StoreError, compared, required_store
from evaweb.episodes import services
from evaweb.episodes.folders import data_dir, journal_folder
from evaweb.episodes.models import Episode
from evaweb.episodes.reconcile import ingest_one
from evaweb.jobs.selectors import job_newest
from runtime.core.sentences import Pattern
from runtime.link.incoming import arrivals, progress_of

log = logging.getLogger(__name__)
_NOT_HERE = Pattern("episodes.arriving.not_here", "It is on the computer of station {station}, not here yet.")
_PARTLY_HERE = Pattern(
    "episodes.arriving.partly_here",
    "It is on the computer of station {station}, not here yet: {here} of {size} MB.",
)
_DECLINED = Pattern(
    "episodes.arriving.declined",
    "It is on the computer of station {station}, not here yet: {why}.",
)


def owner_of(uuid: str) -> str:
    """Return the name of the station that owns an episode, "" if unknown.

    Raises: OSError if the database does not answer.
    """
    try:
        return Episode.objects.filter(uuid=uuid).values_list("station__name", flat=True).first() or ""
    except Error as error:
        raise OSError(str(error)) from error
    finally:
        close_old_connections()


def read_back(digest: str) -> None:
    """Read an object of the lab's store. Raises: OSError if it is absent or another one."""
    try:
        compared(required_store(), digest)
    except StoreError as error:
        raise OSError(str(error)) from error


def whereabouts(episode: Episode) -> str:
    """Return a message that says where an episode in transfer is, and how much of it has arrived."""
    name = episode.station.name
    progress = progress_of(data_dir(), name, str(episode.uuid))
    if progress is None:
        return _NOT_HERE(station=name)
    if progress.why:
        return _DECLINED(station=name, why=progress.why.rstrip("."))
    return _PARTLY_HERE(station=name, here=_megabytes(progress.here), size=_megabytes(progress.size))


def ingest_arrived() -> int:
    """Create rows of newly arrived episodes and labels; return the number of episodes."""
    marks = {UUID(uuid): mark for uuid, mark in arrivals(data_dir())}
    waited_for = Episode.objects.filter(away_since__isnull=False).values_list("uuid", flat=True)
    arrived = {uuid for uuid in waited_for if journal_folder(uuid).is_dir()}
    for uuid in arrived.union(marks):
        for problem in ingest_one(uuid):
            log.warning("episode %s has arrived: %s", uuid, problem)
        episode = Episode.objects.filter(uuid=uuid, away_since=None).first()
        if episode is not None and job_newest(key=f"publish:{uuid}") is not None:
            services.request_publish(episode=episode)  # an earlier job found nothing to publish
        if uuid in marks:
            marks[uuid].unlink(missing_ok=True)
    return len(arrived.union(marks))


def _megabytes(count: int) -> str:
    return f"{count / 1e6:.1f}" if count < 10e6 else f"{count / 1e6:.0f}"
