"""Nothing that an operator can reach tells which checkpoint a blind trial is of, before the reveal.

Every named address is asked in every stage of a trial, with the first of the things there are that it answers for, and
everything that the live socket sends is read. An address with a parameter that is not known here fails the test.
"""

from __future__ import annotations

import pytest
from django.test import Client
from django.urls import reverse

from evaweb.api.tokens import create_token
from evaweb.blinding.visibility import visibility_for_user
from evaweb.plans.blinding_rules import record_unblinding
from evaweb.plans.models import Handout, Look, PlanEvent, Slot
from evaweb.plans.services import reveal_plan
from evaweb.preflights.models import Preflight
from evaweb.trials.models import Checkpoint
from tests.evaweb.blind_lab import LATENCY, NAMES, SECRETS, BlindLab
from tests.evaweb.crawling import QUERIES, crawled, distinguishable, find_leaks, secrets_in, websocket_texts
from tests.evaweb.episodes.conftest import recorded  # noqa: F401  a fixture
from tests.evaweb.two_worlds import differences, read, swap
from tests.evaweb.unguarded import without_triggers

pytestmark = [pytest.mark.django_db(transaction=True), pytest.mark.slow]


@pytest.fixture(autouse=True)
def _data(settings, tmp_path, monkeypatch, nobody_computes):  # what is planned is of no trial
    settings.DATA_DIR = tmp_path
    monkeypatch.setattr("evaweb.jobs.doorbell.notify_workers", lambda queue: True)


@pytest.fixture
def lab(live, runtime, ann, recorded, settings):  # noqa: F811
    """A frozen plan of olga's, a runtime that says secrets, a scene, and an operator."""
    return BlindLab(live, runtime, ann, recorded["finished"], settings.DATA_DIR)


STAGES = ("before", "allocate", "running", "failed", "scored", "closed")


def told_by(lab, user):
    """Somebody's browser."""
    client = Client()
    client.force_login(user)
    return client


@pytest.mark.parametrize(
    ("who", "looked_at"),
    [
        ("alma", "scored"),
        *(
            pytest.param(who, stage, marks=pytest.mark.exhaustive)
            for who in ("alma", "vera", "owner", "operator")
            for stage in STAGES[1:]
            if (who, stage) != ("alma", "scored")
        ),
    ],
)
def test_in_two_worlds_that_differ_in_the_checkpoint_of_a_trial_alone_everything_reads_alike(
    lab, alma, vera, who, looked_at
):
    user = {"alma": alma, "vera": vera}.get(who) or getattr(lab, who)
    if who == "alma":
        lab.operator = alma  # who runs the trials, and administers
    for stage in STAGES[1 : STAGES.index(looked_at) + 1]:
        getattr(lab, stage)()
    client = told_by(lab, user)
    gate = who == "alma" and looked_at == "scored"
    asked = {"administers": who == "alma", "every": not gate, "posts": looked_at == "closed"}
    asked |= {"queries": () if gate else QUERIES}
    asked["uncovers"] = looked_at != "closed" or who not in ("alma", "owner")  # those two may, by then
    here = read(lab, client, **asked)
    outside = [row for row in here if reverse("admin:index") not in row[0]]
    assert list(secrets_in(outside)) == []
    swap(lab)
    found = differences(here, read(lab, client, **asked))
    assert found == [], "\n".join(found)


def test_nothing_that_an_operator_can_reach_tells_before_the_reveal(lab):
    client = told_by(lab, lab.operator)
    for stage in STAGES[1:]:
        getattr(lab, stage)()
        assert websocket_texts(lab, lab.operator) == [], stage
    by_name = [client.get(reverse("api:checkpoint", args=[name])).status_code for name in NAMES]
    assert by_name == [404, 404]
    assert client.get(reverse("api:trials"), {"checkpoint": NAMES[0]}).status_code == 404
    lab.plan = reveal_plan(user=lab.owner, plan=lab.plan)
    assert NAMES.index(lab.trial.checkpoint.name) >= 0
    shown = client.get(reverse("api:trial", args=[lab.trial.pk])).json()
    assert shown["checkpoint"] == lab.trial.checkpoint.name
    assert shown["code"]
    assert LATENCY in websocket_texts(lab, lab.operator)


@pytest.mark.exhaustive
def test_lists_answer_alike_to_questions_for_either_until_the_reveal(lab):
    client = told_by(lab, lab.operator)
    for stage in STAGES[1:]:
        getattr(lab, stage)()
    assert list(find_leaks(lab, client, posts=True)) == []
    assert list(distinguishable(lab, client)) == []
    reveal_plan(user=lab.owner, plan=lab.plan)
    told = "".join(text for _, _, text in crawled(lab, client))
    assert all(name in told for name in NAMES)


@pytest.mark.exhaustive
def test_a_token_tells_what_a_login_tells(lab):
    for stage in STAGES[1:5]:
        getattr(lab, stage)()
    bearer = Client(headers={"Authorization": f"Bearer {create_token(user=lab.operator, name='crawler')}"})
    assert list(find_leaks(lab, bearer, QUERIES)) == []


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    "who", ["alma", *(pytest.param(who, marks=pytest.mark.exhaustive) for who in ("operator", "owner"))]
)
def test_a_plan_that_was_lost_with_the_database_goes_on_hiding(lab, alma, who):
    """What comes back from the disk are its trials alone; an administrator may look behind none of them either."""
    for stage in STAGES[1:]:
        getattr(lab, stage)()
    lose(lab.plan)
    user = alma if who == "alma" else getattr(lab, who)
    client = Client()
    client.force_login(user)
    assert list(find_leaks(lab, client, QUERIES)) == []
    assert websocket_texts(lab, user) == []


def lose(plan):
    """As after a database that was lost: no plan, no hand-outs, no codes; its trials are there."""
    with without_triggers("plans"):
        for model in (Look, PlanEvent, Handout, Slot):
            model.objects.filter(plan=plan).delete()
        plan.delete()
        for row in Checkpoint.objects.filter(trials=None):  # on no disk
            Preflight.objects.filter(checkpoint=row).delete()
            row.delete()


@pytest.mark.exhaustive
def test_who_has_looked_is_told_everything(lab):
    lab.allocate()
    lab.running()
    client = Client()
    client.force_login(lab.owner)
    assert list(find_leaks(lab, client)) == []
    record_unblinding(lab.plan, lab.owner)
    assert {secret for _, secret in find_leaks(lab, client)} >= {"secret-alder", "secret-birch", LATENCY}
    assert set(websocket_texts(lab, lab.owner)) >= {"secret-alder", LATENCY, "something_new"}


def test_an_administrator_who_has_run_a_trial_reads_it_in_no_page_of_administration(lab, alma):
    client = Client()
    client.force_login(alma)
    lab.operator = alma
    lab.allocate()
    assert not visibility_for_user(alma).hides_nothing
    for model in ("trials_trial", "trials_score", "stations_command", "episodes_episode", "jobs_job"):
        answer = client.get(reverse(f"admin:{model}_changelist"), headers={"Accept": "text/html"})
        assert answer.status_code == 403, model
        assert not any(secret in answer.content.decode() for secret in SECRETS), model
    assert client.get(reverse("admin:stations_station_changelist")).status_code == 200


SEAMS = {
    "evaweb.blinding.visibility.Visibility.checkpoint_label": lambda self, trial: trial.checkpoint.name,
    "evaweb.blinding.visibility.Visibility.redact_text": lambda self, text: text,
    "evaweb.blinding.visibility.Visibility.policy_of": lambda self, episode: episode.checkpoint,
    "evaweb.blinding.visibility.Visibility.hides_episode": lambda self, episode: False,
    "evaweb.blinding.visibility.Visibility.require_episode": lambda self, episode: None,
    "evaweb.blinding.visibility.Visibility.filter_visible": lambda self, rows, checkpoint="checkpoint": rows,
    "evaweb.blinding.visibility.Visibility.redacts_snapshot": lambda self, station, snapshot: False,
    "evaweb.stations.redaction.redact_answer": lambda data: dict(data),
}


@pytest.mark.exhaustive
def test_without_one_seam_something_tells(lab, monkeypatch):
    client = Client()
    client.force_login(lab.operator)
    for stage in ("allocate", "running", "failed", "scored"):
        getattr(lab, stage)()
    for seam, instead in SEAMS.items():
        with monkeypatch.context() as without:
            without.setattr(seam, instead)
            assert any(find_leaks(lab, client)), seam


@pytest.mark.exhaustive
def test_without_its_seam_a_filter_tells(lab, monkeypatch):
    client = Client()
    client.force_login(lab.operator)
    for stage in ("allocate", "running", "failed", "scored"):
        getattr(lab, stage)()
    monkeypatch.setattr(
        "evaweb.blinding.visibility.Visibility.filter_visible",
        SEAMS["evaweb.blinding.visibility.Visibility.filter_visible"],
    )
    assert any(distinguishable(lab, client))


def test_without_one_seam_the_live_socket_tells(lab, monkeypatch):
    lab.allocate()
    lab.running()
    assert websocket_texts(lab, lab.operator) == []
    for seam in ("redacts_snapshot", "redacts_events"):
        with monkeypatch.context() as without:
            without.setattr(f"evaweb.blinding.visibility.Visibility.{seam}", lambda self, *given: False)
            assert websocket_texts(lab, lab.operator) != [], seam
