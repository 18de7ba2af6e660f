"""Effects of a station's events on demonstrations: assignment to a session, labels. Events may be repeated."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any
from uuid import UUID

from django.db import transaction

from evaweb.collect.models import CollectSession, Demonstration
from evaweb.episodes.folders import data_dir, journal_folder
from evaweb.episodes.manifest import read_recorded_episode
from evaweb.episodes.models import Episode
from evaweb.episodes.services import request_publish
from runtime.recording.files import RecordingError
from runtime.recording.labels import latest_label

log = logging.getLogger(__name__)
TOLD = ("episode_closed", "labelled")
"""Kinds of events that concern demonstrations."""


def apply_station_event(*, event: Mapping[str, Any]) -> Demonstration | None:
    """Apply one row of a station's event log; return its demonstration, None outside any session."""
    data = event.get("data") or {}
    try:
        uuid = UUID(str(data.get("episode") or data.get("uuid")))
    except ValueError:
        return None
    demonstration = get_or_create_demonstration(episode=Episode.objects.filter(pk=uuid).first())
    return None if demonstration is None else sync_label(demonstration=demonstration)


def get_or_create_demonstration(*, episode: Episode | None) -> Demonstration | None:
    """Return the demonstration of an episode; create it if the manifest names a known session."""
    if episode is None:
        return None
    demonstration = Demonstration.objects.filter(pk=episode.pk).first()
    return demonstration or bind_demonstration(episode=episode, session=_session_of(episode))


def bind_demonstration(*, episode: Episode, session: CollectSession | None) -> Demonstration | None:
    """Assign the episode to the session and return its demonstration; None without a session."""
    if session is None:
        return None
    return Demonstration.objects.get_or_create(episode=episode, defaults={"session": session})[0]


def _session_of(episode: Episode) -> CollectSession | None:
    try:
        named = read_recorded_episode(journal_folder(episode.pk)).session.get("uuid")
        return CollectSession.objects.filter(pk=UUID(str(named))).first() if named else None
    except (RecordingError, ValueError) as error:
        log.warning("episode %s: its session is unknown: %s", episode.pk, error)
        return None


@transaction.atomic
def sync_label(*, demonstration: Demonstration) -> Demonstration:
    """Update the row from the newest label on disk; republish a published episode if its result changed."""
    locked = (
        Demonstration.objects.select_for_update(of=("self",))
        .select_related("episode")
        .get(pk=demonstration.pk)
    )
    label = latest_label(data_dir(), str(locked.pk))
    if label is None:
        return locked
    before = locked.result
    locked.result, locked.note, locked.discarded = label.result or "", label.note, label.discarded
    locked.labelled_by, locked.labelled_at = label.by[:150], datetime.fromtimestamp(label.time, UTC)
    locked.save()
    if before != locked.result and locked.episode.dataset_index is not None and not locked.discarded:
        request_publish(episode=locked.episode)
    return locked
