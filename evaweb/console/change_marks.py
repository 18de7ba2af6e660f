"""Detection of changes in a station's database rows, whichever process made them.

Each web process polls the database once per second while a page is open. Workers and other processes therefore need no
message channel to the web process.
"""

from __future__ import annotations

import logging
from typing import Any

from channels.db import database_sync_to_async
from django.db import Error
from django.db.models import Count, Max, Q

from evaweb.collect.models import Demonstration, SessionEvent
from evaweb.episodes.models import Episode, EpisodeStatus
from evaweb.jobs.models import Job, JobStatus
from evaweb.stations.models import Lease, LeaseRequest
from evaweb.trials.models import Score, Trial

log = logging.getLogger(__name__)
ChangeMarks = dict[str, Any]


async def read_marks(station: str) -> ChangeMarks | None:
    """Return the station's current marks; None if the database does not answer.

    In that case the page keeps receiving live data, which do not depend on the database.
    """
    try:
        return await database_sync_to_async(change_marks, thread_sensitive=False)(station)
    except Error as error:
        log.warning("the database does not say what has changed: %s", error)
        return None


def changed_names(before: ChangeMarks, now: ChangeMarks) -> list[str]:
    """Return the names of entries whose marks differ."""
    return sorted(name for name in now if now[name] != before.get(name))


def change_marks(station: str) -> ChangeMarks:
    """Return one mark per topic; the mark of a topic is another one after every change of the topic's rows."""
    of_station = Q(station__name=station)
    return {
        "lease": (
            Lease.objects.filter(of_station).aggregate(
                Max("id"), Max("ended_at"), open=Count("id", Q(ended_at=None))
            ),
            LeaseRequest.objects.filter(of_station).aggregate(Max("id"), Max("answered_at")),
        ),
        "trial": (
            Trial.objects.filter(of_station).aggregate(Max("id"), Max("changed_at")),
            Score.objects.filter(trial__station__name=station).aggregate(Max("id")),
        ),
        "episode": Episode.objects.filter(of_station).aggregate(
            Max("created_at"),
            Max("previewed_at"),
            Max("published_at"),
            open=Count("pk", Q(status=EpisodeStatus.RECORDING)),
        ),
        "collect": (
            SessionEvent.objects.filter(session__station__name=station).aggregate(Max("id")),
            Demonstration.objects.filter(session__station__name=station).aggregate(
                Max("labelled_at"), count=Count("pk"), discarded=Count("pk", Q(discarded=True))
            ),
        ),
        "job": Job.objects.aggregate(
            Max("id"),
            Max("finished_at"),
            waiting=Count("id", Q(status=JobStatus.QUEUED)),
            running=Count("id", Q(status=JobStatus.RUNNING)),
        ),
    }
