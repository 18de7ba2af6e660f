"""Queries on sessions and their demonstrations."""

from __future__ import annotations

from dataclasses import dataclass
from uuid import UUID

from django.db.models import Count, F, Q, QuerySet

from evaweb.collect.models import CollectSession, Demonstration, Result
from evaweb.core.errors import NotFound
from evaweb.episodes.folders import datasets_dir
from evaweb.episodes.models import EpisodeStatus
from evaweb.episodes.publishing import session_dataset
from evaweb.stations.models import Station
from runtime.core.sentences import Pattern
from runtime.datasets.catalog import Catalog
from runtime.datasets.layout import DEFAULT_VERSION, WRITABLE_VERSIONS
from runtime.recording.files import RecordingError

_SESSION_DOES_NOT_EXIST_THIS = Pattern(
    "collect.selectors.session_does_not_exist_this",
    "session {uuid} does not exist in this lab",
)

EARLIER = 12  # sessions offered for resuming, tasks offered for reuse
PUBLISHED_RESULTS = (Result.SUCCESS.value, Result.PARTIAL.value)


@dataclass(frozen=True, slots=True)
class Counts:
    """Numbers of a session's episodes.

    Attributes:
        saved: Complete episodes with at least one row that are not discarded, whatever their result.
        success: Saved episodes with this result.
        partial: Saved episodes with this result.
        fail: Saved episodes with this result.
        unlabelled: Saved episodes without a result.
        discarded: Discarded episodes.
        cut: Incomplete episodes that are not discarded.
        published: Episodes that are in a dataset.
    """

    saved: int
    success: int
    partial: int
    fail: int
    unlabelled: int
    discarded: int
    cut: int
    published: int


@dataclass(frozen=True, slots=True)
class Dataset:
    """Target dataset of a session.

    `version` is the format version of the dataset, "" if the dataset does not exist yet.
    """

    name: str
    version: str
    problem: str = ""

    @property
    def versions(self) -> tuple[str, ...]:
        """Versions that can be requested, the default first."""
        if self.version:
            return (self.version,)
        other_versions = (version for version in WRITABLE_VERSIONS if version != DEFAULT_VERSION)
        return (DEFAULT_VERSION, *other_versions)


def session_list(
    *, station: str = "", dataset: str = "", is_open: bool | None = None
) -> QuerySet[CollectSession]:
    """Return the sessions, newest first."""
    rows = CollectSession.objects.select_related("station", "operator").order_by("-opened_at", "pk")
    lookups = {"station__name": station, "dataset": dataset}
    rows = rows.filter(**{name: value for name, value in lookups.items() if value})
    return rows if is_open is None else rows.filter(closed_at__isnull=is_open)


def session_get(*, uuid: UUID) -> CollectSession:
    """Return the session. Raises: NotFound."""
    session = session_list().filter(pk=uuid).first()
    if session is None:
        raise NotFound(_SESSION_DOES_NOT_EXIST_THIS(uuid=uuid))
    return session


def session_open(*, station: Station) -> CollectSession | None:
    """Return the station's open session, None if there is none."""
    return session_list(is_open=True).filter(station=station).first()


def resumable_sessions(*, station: Station) -> QuerySet[CollectSession]:
    """Return the closed sessions of the station, most recently closed first."""
    closed = session_list(is_open=False).filter(station=station)
    return closed.annotate(saved=Count("demonstrations", _saved("demonstrations__"))).order_by("-closed_at")[
        :EARLIER
    ]


def earlier_tasks(*, station: Station) -> list[str]:
    """Return the distinct tasks demonstrated at the station, newest first."""
    newest = session_list().filter(station=station).values_list("task", flat=True)
    return list(dict.fromkeys(newest[:200]))[:EARLIER]


def session_counts(*, session: CollectSession) -> Counts:
    """Return the numbers of the session's episodes."""
    cut = Q(discarded=False, episode__status__in=(EpisodeStatus.INTERRUPTED, EpisodeStatus.FAILED))
    conditions = {
        "saved": _saved(),
        **{result.value or "unlabelled": _saved() & Q(result=result) for result in Result},
        "discarded": Q(discarded=True),
        "cut": cut,
        "published": Q(episode__dataset_index__isnull=False),
    }
    # Prefixed names: an aggregate with a field's name would shadow the field in later ones.
    counted = session.demonstrations.aggregate(
        **{f"n_{name}": Count("pk", of) for name, of in conditions.items()}
    )
    return Counts(**{name: counted[f"n_{name}"] for name in conditions})


def _saved(path: str = "") -> Q:
    """Return the condition for saved demonstrations; `path` is the query path to them."""
    named = {"discarded": False, "episode__frames__gt": 0, "episode__status": EpisodeStatus.FINISHED}
    return Q(**{f"{path}{name}": value for name, value in named.items()})


def demonstrations_of(*, session: CollectSession) -> QuerySet[Demonstration]:
    """Return the session's demonstrations, newest first."""
    newest = (F("episode__started_at").desc(nulls_last=True), "-episode__created_at")
    return session.demonstrations.select_related("episode__standing__review").order_by(*newest)


def accepted_demonstrations(*, session: CollectSession, results: tuple[str, ...]) -> QuerySet[Demonstration]:
    """Return the session's demonstrations that may be published.

    They are complete, not discarded, have one of `results`, and were not failed by a review.
    """
    return (
        demonstrations_of(session=session)
        .filter(_saved(), result__in=results)
        .exclude(episode__standing__review__verdict="fail")
    )


def unpublished_demonstrations(
    *, session: CollectSession, results: tuple[str, ...] = PUBLISHED_RESULTS
) -> QuerySet[Demonstration]:
    """Return the accepted demonstrations that are in no dataset yet, in order of recording."""
    waiting = accepted_demonstrations(session=session, results=results).filter(episode__dataset_index=None)
    return waiting.order_by("episode__started_at", "episode__created_at")


def dataset_of(*, session: CollectSession) -> Dataset:
    """Return the session's target dataset; `problem` is the reason why nothing can be published there."""
    name = session_dataset(session.dataset, simulated=session.station.simulated)
    folder = datasets_dir() / name
    if not folder.is_dir():
        return Dataset(name, "")
    try:
        return Dataset(name, Catalog.read(folder).version)
    except RecordingError as error:
        return Dataset(name, "", str(error))
