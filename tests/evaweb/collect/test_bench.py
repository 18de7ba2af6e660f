"""Commands of a session take task and session from it, and a station that is not as it was is not run."""

from __future__ import annotations

from typing import Any
from uuid import uuid4

import pytest
from django.contrib.auth.models import User

from evaweb.collect import services
from evaweb.collect.models import CollectSession, Demonstration
from evaweb.collect.station_commands import session_command
from evaweb.console.event_ingest import ingest_events
from evaweb.console.feed import History
from evaweb.core.errors import Conflict, EvaError
from evaweb.episodes.models import Episode
from evaweb.stations.models import Command, CommandStatus, Station
from runtime.ipc import messages
from tests.evaweb.collect.conftest import SETUP, collecting
from tests.evaweb.trials.builders import FakeConnection

pytestmark = pytest.mark.django_db


def give(session: CollectSession, user: User, kind: str, **given: Any) -> Command:
    told = {"page": "p1", "epoch": 1, "boot": "b", "sequence": 1}
    return session_command(user=user, session=session, kind=kind, **{**told, **given})


def test_a_set_up_is_one_to_collect_for_the_sessions_task(
    session: CollectSession, at: FakeConnection, ann: User
) -> None:
    row = give(session, ann, "setup", args={"bench": {"seed": 3}})
    assert row.args == {"bench": {"seed": 3}, "collect": True, "task": "stack the cups"}


def test_a_run_names_the_session_and_its_episode_is_one_of_it(
    session: CollectSession, at: FakeConnection, ann: User
) -> None:
    row = give(session, ann, "run")
    assert row.args == {
        "mode": "collect",
        "task": "stack the cups",
        "operator": "ann",
        "session": {"uuid": str(session.pk), "dataset": "cups"},
    }
    made = Demonstration.objects.get()
    assert (str(made.pk), made.session, made.episode.kind, made.episode.task) == (
        row.data["episode"],
        session,
        "demonstration",
        "stack the cups",
    )


def test_a_refused_run_has_no_episode(session: CollectSession, at: FakeConnection, ann: User) -> None:
    at.status_word, at.reason = "refused", "not armed"
    assert give(session, ann, "run").status == CommandStatus.REFUSED
    assert not Demonstration.objects.exists()


@pytest.mark.parametrize("late", [False, True])
def test_a_demonstration_whose_recording_could_not_be_opened_leaves_nothing_behind(
    session: CollectSession, at: FakeConnection, ann: User, late: bool
) -> None:
    def told(command: messages.Command) -> None:
        never = {"command": command.uuid, "episode": str(at.episode), "unopened": True}
        text = "running -> ready: no room"
        data = {"state": "ready", "unbegun": never}
        row = {"number": 1, "kind": "state", "text": text, "time": 1.0, "data": data}
        ingest_events(station=Station.objects.get(), history=History("b", (row,)))

    if late:  # the answer is heard after the event
        answer = at.request
        at.request = lambda command, **how: (told(command), answer(command, **how))[1]  # type: ignore[method-assign]
    assert give(session, ann, "run").status == CommandStatus.ACCEPTED
    if not late:
        told(at.heard[-1])
    assert not Demonstration.objects.exists()
    assert not Episode.objects.exists()
    assert Command.objects.get().unopened == "running -> ready: no room"


def test_a_station_that_has_changed_is_not_run_and_the_differences_are_listed(
    session: CollectSession, at: FakeConnection, ann: User
) -> None:
    at.snapshot = {**at.snapshot, "collect": collecting(setup={**SETUP, "robot": "g2"})}
    with pytest.raises(Conflict, match=r"session stack the cups \(cups\): robot = g2, allowed agilex_piper"):
        give(session, ann, "run")
    assert not Command.objects.exists()


def test_a_closed_session_is_not_run(session: CollectSession, at: FakeConnection, ann: User) -> None:
    services.close_session(user=ann, session=session)
    with pytest.raises(Conflict, match="is closed: resume it first"):
        give(session, ann, "run")


def test_the_same_uuid_again_gets_the_first_answer_whatever_has_changed_meanwhile(
    session: CollectSession, at: FakeConnection, ann: User
) -> None:
    uuid = uuid4()
    first = give(session, ann, "run", uuid=uuid)
    services.close_session(user=ann, session=session)
    assert give(session, ann, "run", uuid=uuid).data == first.data
    assert Demonstration.objects.count() == 1


@pytest.mark.parametrize(
    ("kind", "args", "said"),
    [
        ("run", {"task": "x"}, "args say task beside the session"),
        ("stop", {}, "stop takes no session; allowed: setup, run"),
    ],
)
def test_what_a_session_does_not_take_is_refused(
    session: CollectSession, at: FakeConnection, ann: User, kind: str, args: dict[str, Any], said: str
) -> None:
    with pytest.raises(EvaError, match=said):
        give(session, ann, kind, args=args)


def test_an_episode_that_is_being_recorded_keeps_its_session_open(
    session: CollectSession, at: FakeConnection, ann: User
) -> None:
    episode = give(session, ann, "run").data["episode"]
    at.snapshot = {**at.snapshot, "collect": collecting(episode=episode)}
    with pytest.raises(Conflict, match="stop it first"):
        services.close_session(user=ann, session=session)
