"""What is found by a few letters, by whom, and how much is looked at for it."""

import json

import pytest
from django.db import connection
from django.test import Client
from django.test.utils import CaptureQueriesContext

from evaweb.blinding.visibility import visibility_for_user
from evaweb.core.errors import EvaError
from evaweb.find.selectors import LONGEST, MOST, find
from evaweb.plans.allocation import allocate_trial
from evaweb.plans.blinding_rules import record_unblinding
from evaweb.plans.models import Plan
from evaweb.plans.services import freeze_plan
from evaweb.stations.models import Station
from evaweb.trials.models import Checkpoint
from tests.evaweb.blind_lab import NAMES
from tests.evaweb.trials import builders

pytestmark = pytest.mark.django_db


@pytest.fixture(autouse=True)
def _data_dir(settings, tmp_path):
    settings.DATA_DIR = tmp_path
    info = tmp_path / "datasets" / "cups" / "meta" / "info.json"
    info.parent.mkdir(parents=True)
    info.write_text("{}")


@pytest.fixture
def bench():
    return builders.bench()


def found(query, user):
    """Group -> titles."""
    groups = find(query=query, user=user, sight=visibility_for_user(user))
    return {group.name: [one.title for one in group.items] for group in groups}


def blind_plan(bench, owner):
    rows = [Checkpoint.objects.create(name=name, policy={"url": "ws://127.0.0.1:9"}) for name in NAMES]
    plan = Plan.objects.create(name="blocks", title="Blocks", owner=owner)
    plan.checkpoints.set(rows)
    plan.positions.set(bench.scene.positions.all())
    return freeze_plan(user=owner, plan=plan)


def test_each_kind_is_found_by_its_names(bench):
    ann, trial = bench.operator, bench.ended()
    assert found("bench-1", ann)["Stations"] == ["bench-1"]
    assert found("bench deb", ann)["Stations"] == ["bench-1 · Debug"]
    assert found(f"#{trial.pk}", ann)["Trials"][0] == f"Trial {trial.pk}"
    assert found(f"trial {trial.pk}", ann)["Trials"][0] == f"Trial {trial.pk}"
    assert found(str(trial.episode_id)[:13], ann)["Episodes"] == [str(trial.episode_id)]
    assert found("pi0", ann)["Checkpoints"] == ["pi0-block"]
    assert found("plate block", ann)["Scenes"] == ["block on plate"]
    assert found("cups", ann)["Datasets"] == ["cups"]
    assert found("planner", ann)["Pages"] == ["How many trials?"]
    assert found("no such thing", ann) == {}


def test_an_address_leads_to_a_page_that_the_user_may_open(bench, settings):
    for role in ("viewer", "operator", "admin"):
        user = builders.user(f"a-{role}", role)
        browser = Client()
        browser.force_login(user)
        for query in ("e", "bench", "pi0", "plate", "administration", "cups"):
            for group in find(query=query, user=user, sight=visibility_for_user(user)):
                for one in group.items:
                    assert browser.get(one.address).status_code == 200, one


def test_the_nearest_comes_first_and_no_more_than_a_few(bench):
    for number in range(12):
        Station.objects.create(name=f"a-bench-{number}", robot="agilex_piper")
    Station.objects.create(name="bench", robot="agilex_piper")
    group = find(query="bench", user=bench.operator, sight=visibility_for_user(bench.operator))[0]
    assert [one.title for one in group.items[:3]] == ["bench", "bench-1", "a-bench-0"]
    assert (len(group.items), group.more) == (MOST, True)


@pytest.mark.parametrize("query", ["", "   ", "x" * (LONGEST + 1)])
def test_a_query_that_is_too_short_or_too_long_is_refused(bench, query):
    with pytest.raises(EvaError, match=f"allowed: 1 to {LONGEST}"):
        find(query=query, user=bench.operator, sight=visibility_for_user(bench.operator))


def test_what_is_hidden_is_neither_found_nor_counted(bench):
    olga = builders.user("olga")
    plan = blind_plan(bench, olga)
    trial = allocate_trial(user=bench.operator, station=bench.station, plan=plan).trial
    code = trial.handout.code
    browser = Client()
    browser.force_login(bench.operator)
    for query in (*NAMES, "secret", "pi0", "alder", str(trial.checkpoint_id), code, str(trial.pk)):
        told = json.dumps(browser.get("/api/v1/find", {"q": query}).json())
        assert "alder" not in told, query
        assert "birch" not in told, query
    assert found("secret", bench.operator) == {}
    assert found("pi0", bench.operator) == {"Checkpoints": ["pi0-block"]}
    assert found(code.lower(), bench.operator)["Trials"] == [f"Trial {trial.pk} · {code}"]
    record_unblinding(plan, olga)
    assert found("secret", olga)["Checkpoints"] == list(NAMES)


def test_a_draft_is_found_by_its_owner_and_by_administrators(bench):
    olga = builders.user("olga")
    Plan.objects.create(name="later", title="Something later", owner=olga)
    assert "Plans" not in found("later", bench.operator)
    assert found("later", olga)["Plans"] == ["Something later"]
    assert found("later", builders.user("root", "admin"))["Plans"] == ["Something later"]


def test_nobody_finds_without_being_logged_in():
    assert Client().get("/api/v1/find", {"q": "bench"}).status_code == 401


@pytest.mark.skipif(connection.vendor != "sqlite", reason="reads the plans of SQLite")
@pytest.mark.parametrize("query", ["1", "12345", "AB", "ABCDE", "dead", "some words of a note"])
def test_of_what_there_is_much_of_no_table_is_gone_through(bench, query):
    with CaptureQueriesContext(connection) as asked:
        found(query, bench.operator)
    many = ("trials_trial", "plans_handout", "episodes_episode", "trials_score")
    for sql in [row["sql"] for row in asked if row["sql"].startswith("SELECT")]:
        with connection.cursor() as cursor:
            cursor.execute(f"EXPLAIN QUERY PLAN {sql}")
            steps = [row[-1] for row in cursor.fetchall()]
        assert not [step for step in steps if step.startswith("SCAN") and step.split()[1] in many], (
            sql,
            steps,
        )
