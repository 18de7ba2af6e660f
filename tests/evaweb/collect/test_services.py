"""Sessions: opened with a set-up, closed, resumed where it is the same, published; a line before every row."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from django.contrib.auth.models import User
from django.db import IntegrityError, connection, transaction

from evaweb.collect import selectors, services
from evaweb.collect.models import CollectSession
from evaweb.collect.record import SESSIONS
from evaweb.core.errors import Conflict, EvaError, NotAllowed
from evaweb.datasets import episode_list
from evaweb.jobs.models import Job
from evaweb.jobs.services import run_queue
from evaweb.reviews import services as reviews
from evaweb.stations.models import Station
from runtime.datasets.reader import open_dataset
from tests.evaweb.collect.conftest import SETUP, Demonstrate, collecting, labelled
from tests.evaweb.trials.builders import FakeConnection

pytestmark = pytest.mark.django_db


def kinds(session: CollectSession) -> list[str]:
    return [json.loads(line)["kind"] for line in SESSIONS.path(session.pk).read_text().splitlines()]


def test_a_session_has_the_set_up_of_its_station_and_a_line_on_the_disk(
    session: CollectSession, ann: User
) -> None:
    assert (session.dataset, session.task, session.target, session.setup) == (
        "cups",
        "stack the cups",
        20,
        SETUP,
    )
    line = json.loads(SESSIONS.path(session.pk).read_text())
    assert (line["kind"], line["by"], line["station"], line["setup"]) == ("opened", "ann", "bench", SETUP)
    assert [event.kind for event in session.events.all()] == ["opened"]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"task": "  "}, "task is empty"),
        ({"dataset": "../cups"}, "dataset = '../cups'; allowed: 1 to 100 letters"),
        ({"dataset": "Rollouts-x"}, "those of policies' runs"),
        ({"target": 0}, "target = 0; allowed: 1 to 100000"),
    ],
)
def test_what_cannot_be_a_session_is_refused_by_name(
    at: FakeConnection, data: Path, station: Station, ann: User, given: dict, said: str
) -> None:
    with pytest.raises(EvaError, match=said):
        services.open_session(user=ann, station=station, **{"task": "stack", **given})
    assert not CollectSession.objects.exists()


def test_a_viewer_opens_none_and_nobody_while_another_commands(
    at: FakeConnection, data: Path, station: Station, ann: User, vera: User
) -> None:
    with pytest.raises(NotAllowed):
        services.open_session(user=vera, station=station, task="stack")
    at.snapshot = {**at.snapshot, "lease": {"holder": "web:bob:1234", "epoch": 3}}
    with pytest.raises(Conflict, match="bob commands bench"):
        services.open_session(user=ann, station=station, task="stack")


def test_one_session_at_a_time_and_it_is_resumed_after_it_was_closed(
    session: CollectSession, ann: User
) -> None:
    with pytest.raises(Conflict, match="a session is open at bench"):
        services.open_session(user=ann, station=session.station, task="another")
    closed = services.close_session(user=ann, session=session)
    assert closed.closed_at is not None
    with pytest.raises(Conflict, match="closed already"):
        services.close_session(user=ann, session=session)
    assert services.resume_session(user=ann, session=session).closed_at is None
    assert selectors.session_open(station=session.station) == session
    assert kinds(session) == ["opened", "closed", "resumed"]


def test_a_changed_set_up_is_not_resumed_and_every_difference_is_listed(
    session: CollectSession, at: FakeConnection, ann: User
) -> None:
    services.close_session(user=ann, session=session)
    other = {**SETUP, "fps": 50.0, "cameras": {"cam_high": {"width": 640, "height": 480}}}
    at.snapshot = {**at.snapshot, "collect": collecting(setup=other)}
    with pytest.raises(Conflict) as refused:
        services.resume_session(user=ann, session=session)
    assert str(refused.value) == (
        "the set-up differs from that of session stack the cups (cups): fps = 50, allowed 30; "
        "camera cam_high = 640x480, allowed 64x48"
    )
    assert kinds(session) == ["opened", "closed"]
    with pytest.raises(Conflict, match="from that of the dataset cups: fps = 50"):
        services.open_session(user=ann, station=session.station, task="another")


def test_the_database_keeps_what_a_session_is(session: CollectSession) -> None:
    with pytest.raises(IntegrityError, match="open another one"), transaction.atomic():
        CollectSession.objects.filter(pk=session.pk).update(task="something else")
    with pytest.raises(IntegrityError, match="never changed or removed"), transaction.atomic():
        session.events.update(text="something else")
    assert connection.vendor in ("sqlite", "postgresql")


def test_episodes_are_counted_by_result_and_those_that_were_cut_or_discarded_apart(
    session: CollectSession, demonstrate: Demonstrate, data: Path, ann: User
) -> None:
    for result in ("success", "success", "partial", "fail", None):
        demonstrate(result)
    demonstrate(status="interrupted")
    labelled(data, demonstrate(), None, discarded=True)
    counts = selectors.session_counts(session=session)
    assert (counts.saved, counts.success, counts.partial, counts.fail) == (5, 2, 1, 1)
    assert (counts.unlabelled, counts.discarded, counts.cut, counts.published) == (1, 1, 1, 0)
    services.close_session(user=ann, session=session)
    assert [row.saved for row in selectors.resumable_sessions(station=session.station)] == [5]


def test_accepted_episodes_go_to_the_sessions_dataset_in_the_version_that_is_asked_for(
    session: CollectSession, demonstrate: Demonstrate, data: Path, ann: User
) -> None:
    good, partial, bad, failed, discarded = (
        demonstrate(one) for one in ("success", "partial", "fail", "success", "success")
    )
    labelled(data, discarded, "success", discarded=True)
    reviews.add_review(user=ann, episode=failed.episode, verdict="fail")
    Job.objects.all().delete()
    with pytest.raises(Conflict, match=r"version = 'v1.0'; allowed: v2.1, v3.0"):
        services.publish_session(user=ann, session=session, version="v1.0")
    jobs = services.publish_session(user=ann, session=session, version="v3.0")
    assert {job.key for job in jobs} == {f"publish:{good.pk}", f"publish:{partial.pk}"}
    assert run_queue("cpu") >= 2
    assert not Job.objects.exclude(error="").exists()
    dataset = open_dataset(data / "datasets" / "cups")
    assert len(dataset.episodes) == 2
    said = [(row.success, row.result) for row in episode_list.list_rows("datasets/cups")]
    assert sorted(said) == [(False, "partial"), (True, "success")]  # whichever was written first
    assert [row.result for row in episode_list.list_rows("datasets/cups", result="partial")] == ["partial"]
    assert selectors.dataset_of(session=session).version == "v3.0"
    with pytest.raises(Conflict, match="nothing to publish"):
        services.publish_session(user=ann, session=session)
    with pytest.raises(Conflict, match="is of that version already, convert it"):
        services.publish_session(user=ann, session=session, version="v2.1")
    Job.objects.all().delete()
    assert [job.key for job in services.publish_session(user=ann, session=session, results=["fail"])] == [
        f"publish:{bad.pk}"
    ]


def test_what_is_labelled_otherwise_after_it_was_published_goes_there_anew(
    session: CollectSession, demonstrate: Demonstrate, data: Path, ann: User
) -> None:
    made = demonstrate("success")
    services.publish_session(user=ann, session=session)
    run_queue("cpu")
    Job.objects.all().delete()
    labelled(data, made, "fail")
    assert [job.key for job in Job.objects.all()] == [f"publish:{made.pk}"]
    assert run_queue("cpu") == 1
    lines = (data / "datasets" / "cups" / "meta" / "eva_episodes.jsonl").read_text().splitlines()
    assert [json.loads(line)["success"] for line in lines] == [False]


def test_what_was_discarded_while_its_publication_waited_is_not_published(
    session: CollectSession, demonstrate: Demonstrate, data: Path, ann: User
) -> None:
    made = demonstrate("success")
    services.publish_session(user=ann, session=session)
    labelled(data, made, "success", discarded=True)
    run_queue("cpu")
    job = Job.objects.get(kind="publish")
    assert (job.status, job.result) == ("done", {"published": False, "why": "it was discarded by ann"})
    assert not (data / "datasets" / "cups").exists()
