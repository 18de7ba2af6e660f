"""What matters now, for whom, and as little as they may see."""

from collections import namedtuple
from datetime import timedelta

import pytest
from django.db import connection
from django.test import Client
from django.test.utils import CaptureQueriesContext
from django.utils import timezone

from evaweb.blinding.visibility import visibility_for_user
from evaweb.console import home, stills
from evaweb.console.feed import LinkState, feeds
from evaweb.core.errors import Conflict, StationGone
from evaweb.episodes.models import Episode
from evaweb.jobs.models import Job
from evaweb.plans.allocation import allocate_trial
from evaweb.plans.models import Plan
from evaweb.plans.services import freeze_plan
from evaweb.stations.models import Lease, LeaseRequest
from evaweb.trials.models import Checkpoint, Trial
from tests.evaweb.blind_lab import NAMES
from tests.evaweb.trials import builders
from tests.standing import state_flags

pytestmark = pytest.mark.django_db
Usage = namedtuple("Usage", "total used free")


@pytest.fixture(autouse=True)
def _room(monkeypatch, settings, tmp_path):
    settings.DATA_DIR = tmp_path
    monkeypatch.setattr(home.shutil, "disk_usage", lambda path: Usage(1e12, 5e11, 5e11))


@pytest.fixture
def bench(monkeypatch):
    made = builders.bench()
    monkeypatch.setattr(feeds.get(made.station.name), "link", LinkState(True))
    return made


def seen(user):
    return home.now(user=user, sight=visibility_for_user(user))


def texts(items):
    return [item.text for item in items]


def test_a_quiet_lab_says_nothing(bench):
    found = seen(bench.operator)
    assert (found.work, found.alarms, found.plans, found.jobs) == ([], [], [], [])


def test_what_an_operator_began_waits_for_that_operator_alone(bench):
    trial = bench.prepare()
    assert texts(seen(bench.operator).work) == [f"Trial {trial.pk}, block on plate, position 1: prepared"]
    builders.finished_trial(trial)
    item = seen(bench.operator).work[0]
    assert (item.address, item.go) == (f"/result/trials/{trial.pk}/", "Score it")
    assert texts(seen(builders.user("ben")).work) == ["1 episode is waiting for a review"]
    assert seen(builders.user("visitor", "viewer")).work == []


def test_who_asks_for_my_station_is_said(bench):
    ben = builders.user("ben")
    Lease.objects.create(station=bench.station, user=bench.operator, holder="web:ann:1", epoch=1)
    LeaseRequest.objects.create(station=bench.station, user=ben, holder="web:ben:1")
    assert texts(seen(bench.operator).work) == ["ben asks for bench-1, which you command"]
    assert seen(ben).work == []


@pytest.mark.parametrize(
    ("ages", "lost"),
    [
        ({"joints": 0.1, "cam_high": 0.2, "cam_low": 0.1}, []),
        ({"joints": 0.1, "cam_high": 0.2, "cam_low": None}, ["bench-1 has no picture of cam_low"]),
        ({"joints": 0.1, "cam_high": 30.0, "cam_low": 11.0}, ["bench-1 has no picture of cam_high, cam_low"]),
        ({"joints": None, "cam_high": None, "cam_low": None}, []),  # nothing arrives: it is disconnected
        ({}, []),
    ],
)
def test_a_camera_that_is_lost_is_an_alarm(bench, monkeypatch, ages, lost):
    monkeypatch.setattr(feeds.get("bench-1"), "state", {"link": {"ages": ages}})
    assert texts(seen(bench.operator).alarms) == lost


def test_alarms_are_said_until_they_are_over(bench, monkeypatch):
    long_ago = timezone.now() - timedelta(days=40)
    monkeypatch.setattr(feeds.get("bench-1"), "link", LinkState(False, "bench-1 is not running"))
    monkeypatch.setattr(home.shutil, "disk_usage", lambda path: Usage(1e12, 9.5e11, 5e10))
    Episode.objects.create(station=bench.station, status="finished", damage=[{"file": "rows.arrow"}])
    Episode.objects.update(created_at=long_ago)
    Job.objects.create(kind="preview", key="preview:1", status="failed")
    Job.objects.create(kind="preview", key="preview:2")
    Job.objects.filter(status="queued").update(created_at=long_ago)
    assert texts(seen(bench.operator).alarms) == [
        "bench-1 is not running",
        "The disk of the lab is nearly full: 50.0 GB of 1000 GB free",
        "1 recording is damaged",
        "1 recording was not verified in time",
        "1 job failed",
        "No worker is running: start one with manage.py worker.",
    ]
    Episode.objects.update(damage=[], verified_at=timezone.now())
    Job.objects.update(status="done")
    assert texts(seen(bench.operator).alarms)[2:] == []


def test_a_station_that_needs_somebody_is_said_without_why(bench, monkeypatch):
    state = {**state_flags("faulted"), "reason": NAMES[0]}
    monkeypatch.setattr(feeds.get("bench-1"), "state", state)
    assert texts(seen(bench.operator).alarms) == ["bench-1 is faulted"]
    monkeypatch.setattr(feeds.get("bench-1"), "state", state_flags("ready"))
    assert seen(bench.operator).alarms == []


def test_of_a_blind_plan_home_says_how_far_it_is_and_no_more(bench):
    olga = builders.user("olga")
    plan = Plan.objects.create(name="blocks", title="Blocks", owner=olga)
    plan.checkpoints.set(Checkpoint.objects.create(name=name, policy={"url": "ws://h:1"}) for name in NAMES)
    plan.positions.set(bench.scene.positions.all())
    plan = freeze_plan(user=olga, plan=plan)
    trial = allocate_trial(user=bench.operator, station=bench.station, plan=plan).trial
    Job.objects.create(kind="quality", key="quality:1", status="running", progress=f"{NAMES[0]} 2 of 3")
    shown = seen(bench.operator)
    assert [(one.row.foreseen, one.evidence) for one in shown.plans] == [(4, "")]
    assert "blind until" in shown.plans[0].sealed
    browser = Client()
    browser.force_login(bench.operator)
    for headers in ({}, {"HX-Request": "true"}, {"HX-Request": "true", "HX-Target": "now"}):
        text = browser.get("/", headers=headers).content.decode()
        assert "secret" not in text
    assert f"Trial {trial.pk}" in text


def test_evidence_is_linked_where_it_may_be_seen(bench):
    plan = Plan.objects.create(name="open", title="Open", owner=bench.operator, blind=False)
    plan.checkpoints.set([bench.checkpoint])
    plan.positions.set(bench.scene.positions.all())
    plan = freeze_plan(user=bench.operator, plan=plan)
    assert [one.evidence for one in seen(bench.operator).plans] == [""]
    trial = builders.finished_trial(
        allocate_trial(user=bench.operator, station=bench.station, plan=plan).trial
    )
    Trial.objects.filter(pk=trial.pk).update(status="scored")
    assert [one.evidence for one in seen(bench.operator).plans] == ["/result/plans/open/1/evidence/"]


def test_questions_do_not_grow_with_what_waits(bench):
    counts = []
    for _ in range(2):
        with CaptureQueriesContext(connection) as asked:
            seen(bench.operator)
        counts.append(len(asked))
        for number in range(3):
            Episode.objects.create(station=bench.station, status="finished", frames=9)
            Job.objects.create(kind="quality", key=f"quality:{len(counts)}{number}", status="failed")
    assert counts[1] <= counts[0] + 1


def test_a_still_is_asked_for_once_for_all_viewers(bench, monkeypatch):
    asked = []

    def now(station, cameras, patience_s):
        asked.append(cameras)
        if len(asked) == 2:
            raise Conflict("no picture from cam_high")
        if len(asked) == 3:
            raise StationGone("the link to its computer is lost")
        return {cameras[0]: b"jpeg"}

    monkeypatch.setattr(stills.image_store, "current_images", now)
    monkeypatch.setattr(stills, "_stills", {})
    browser = Client()
    browser.force_login(bench.operator)
    for _ in range(2):
        answer = browser.get("/stations/bench-1/still")
        assert (answer.content, answer["Content-Type"]) == (b"jpeg", "image/jpeg")
    assert len(asked) == 1
    monkeypatch.setattr(stills, "KEPT_S", -1)
    for _ in range(2):
        assert browser.get("/stations/bench-1/still").status_code == 204
    monkeypatch.setattr(feeds.get("bench-1"), "link", LinkState(False, "gone"))
    assert browser.get("/stations/bench-1/still").status_code == 204
    assert len(asked) == 3
    assert browser.get("/stations/nowhere/still").status_code == 404
