"""What a station tells of demonstrations comes into the database, once; and what is lost there, from the disk."""

from __future__ import annotations

from pathlib import Path
from uuid import uuid4

import pytest
from django.contrib.auth.models import User

from evaweb.collect import services
from evaweb.collect import station_events as following
from evaweb.collect.models import CollectSession, Demonstration, SessionEvent
from evaweb.collect.record import SESSIONS
from evaweb.episodes.models import Episode
from evaweb.episodes.reconcile import reconcile
from tests.evaweb.collect.conftest import SETUP, Demonstrate, labelled
from tests.evaweb.unguarded import without_triggers

pytestmark = pytest.mark.django_db


def test_the_newest_label_counts_and_a_discarded_one_stays_so(demonstrate: Demonstrate, data: Path) -> None:
    made = demonstrate("fail")
    assert (made.result, made.labelled_by, made.discarded) == ("fail", "ann", False)
    assert labelled(data, made, "partial", note="slipped").note == "slipped"
    assert labelled(data, made, "partial", discarded=True).discarded


def test_told_twice_it_is_one_demonstration(demonstrate: Demonstrate, session: CollectSession) -> None:
    made = demonstrate()
    event = {"kind": "episode_closed", "data": {"uuid": str(made.pk)}}
    assert following.apply_station_event(event=event) == made
    assert Demonstration.objects.count() == 1


@pytest.mark.parametrize("data_of", [{}, {"uuid": "none"}, {"episode": str(uuid4())}])
def test_what_is_of_no_session_is_left_alone(data_of: dict, session: CollectSession) -> None:
    assert following.apply_station_event(event={"kind": "labelled", "data": data_of}) is None


def lost() -> None:
    """The database, but for its guards' opinion."""
    with without_triggers("collect"):
        Demonstration.objects.all().delete()
        SessionEvent.objects.all().delete()
        CollectSession.objects.all().delete()


def test_sessions_and_labels_come_back_from_the_disk(
    session: CollectSession, demonstrate: Demonstrate, ann: User
) -> None:
    made = demonstrate("success")
    services.set_session_target(user=ann, session=session, target=7)
    services.close_session(user=ann, session=session)
    lost()
    assert reconcile().problems == ()
    again = CollectSession.objects.get()
    assert (again.pk, again.task, again.dataset, again.setup) == (session.pk, session.task, "cups", SETUP)
    assert (again.target, again.operator, again.station) == (7, ann, session.station)
    assert again.closed_at is not None
    assert [event.kind for event in again.events.all()] == ["opened", "target", "closed"]
    assert Demonstration.objects.get().result == made.result == "success"
    assert reconcile().restored == 0


def test_a_torn_line_of_a_session_is_named_when_it_comes_back(
    session: CollectSession, demonstrate: Demonstrate
) -> None:
    demonstrate("success")
    path = SESSIONS.path(session.pk)
    path.write_bytes(path.read_bytes() + b'{"kind": "clos')
    lost()
    (problem,) = reconcile().problems
    assert problem == f"{path}: line 2 is not whole and was left out: EOF while parsing a string"
    assert CollectSession.objects.get().closed_at is None


def test_without_its_own_file_a_session_is_what_its_episodes_say(
    session: CollectSession, demonstrate: Demonstrate
) -> None:
    made = demonstrate("partial")
    SESSIONS.path(session.pk).unlink()
    lost()
    assert reconcile().problems == ()
    again = CollectSession.objects.get()
    assert (again.pk, again.dataset, again.task, again.target) == (session.pk, "cups", "stack the cups", None)
    assert again.setup["robot"] == "agilex_piper"
    assert len(again.setup["joints"]) == 14
    assert again.closed_at is not None
    assert Demonstration.objects.get().episode == Episode.objects.get(pk=made.pk)
