"""Restoring of lost sessions and demonstrations from the disk."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any
from uuid import UUID

from django.db import transaction
from django.utils import timezone

from evaweb.accounts.roles import get_or_create_person
from evaweb.collect.models import CollectSession, Demonstration, SessionEvent
from evaweb.collect.record import SESSIONS, EventLine
from evaweb.collect.setups import setup_from_manifest
from evaweb.collect.station_events import bind_demonstration, sync_label
from evaweb.core.errors import EvaError
from evaweb.episodes.folders import journal_folder
from evaweb.episodes.manifest import read_recorded_episode
from evaweb.episodes.models import Episode
from evaweb.episodes.reconcile import RestorableRun, register_restorer
from evaweb.episodes.services import get_or_create_station
from evaweb.stations.models import Station
from runtime.core.sentences import Pattern
from runtime.recording.files import read_json

_SESSION_NO_UUID = Pattern("collect.restoring.session_no_uuid", "its session {named!r:.60} is no uuid")
_MANIFEST_DOES_NOT_SAY_HOW = Pattern(
    "collect.restoring.manifest_does_not_say_how",
    "its manifest does not say how its session was set up: {error!r}",
)


@register_restorer
def restore(kept: RestorableRun) -> int:
    """Restore the missing rows of an episode's session and demonstration; return their number."""
    episode = Episode.objects.filter(uuid=kept.uuid).first() if kept.recorded else None
    if episode is None:
        return 0
    named = read_recorded_episode(journal_folder(kept.uuid)).session.get("uuid")
    if not named:
        return 0
    try:
        uuid = UUID(str(named))
    except ValueError:
        raise EvaError(_SESSION_NO_UUID(named=named)) from None
    with transaction.atomic():
        session, created = CollectSession.objects.filter(pk=uuid).first(), 0
        if session is None:
            session, created = _session(uuid, episode, kept), 1
        fresh = not Demonstration.objects.filter(pk=episode.pk).exists()
        demonstration = bind_demonstration(episode=episode, session=session)
        assert demonstration is not None
        sync_label(demonstration=demonstration)
    return created + fresh


def _session(uuid: UUID, episode: Episode, run: RestorableRun) -> CollectSession:
    """Restore a session from its own file or, if that file has no opening event, from a manifest.

    The manifest is that of `episode`, the first episode of the session that was found. A manifest contains neither the
    session's target nor its history.
    """
    events = SESSIONS.read(uuid, run.report_problem)
    first = next((event for event in events if event.kind == "opened"), None)
    if first is None:
        return _from_manifest(uuid, episode)
    station = get_or_create_station(
        name=first.station, robot=str(first.setup.get("robot", "")), simulated=False, source=f"session {uuid}"
    )
    targets = [event.target for event in events if event.kind in ("opened", "target")]
    session = _create(
        uuid,
        station,
        dataset=first.dataset,
        task=first.task,
        operator=get_or_create_person(first.by),
        target=targets[-1],
        setup=first.setup,
        opened_at=first.at,
        closed_at=_closed_at(events),
    )
    for event in events:
        SessionEvent.objects.create(session=session, **event.to_row_values())
    return session


def _closed_at(events: list[EventLine]) -> Any:
    moves = [event for event in events if event.kind in ("opened", "closed", "resumed")]
    return moves[-1].at if moves[-1].kind == "closed" else None


def _from_manifest(uuid: UUID, episode: Episode) -> CollectSession:
    manifest: Mapping[str, Any] = read_json(journal_folder(episode.pk) / "manifest.json")
    try:
        setup, dataset = setup_from_manifest(manifest), str(manifest["session"]["dataset"])
    except (KeyError, TypeError, AttributeError) as error:
        raise EvaError(_MANIFEST_DOES_NOT_SAY_HOW(error=error)) from None
    opened = episode.started_at or timezone.now()
    return _create(
        uuid,
        episode.station,
        dataset=dataset,
        task=episode.task,
        operator=get_or_create_person(episode.operator),
        target=None,
        setup=setup,
        opened_at=opened,
        closed_at=opened,
    )


def _create(uuid: UUID, station: Station, **facts: Any) -> CollectSession:
    """Create the session; it is closed if the station has another open session."""
    if facts["closed_at"] is None and CollectSession.objects.filter(station=station, closed_at=None).exists():
        facts["closed_at"] = timezone.now()
    return CollectSession.objects.create(uuid=uuid, station=station, **facts)
