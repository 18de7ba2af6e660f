"""A data folder that an earlier version wrote gives the rows, and the answers of the API, that it gave then.

`data_of_before/make.py` has made it, once. What came into being later has its default here.
"""

import json

import pytest
from django.contrib.auth.models import User

from evaweb.blinding.visibility import visibility_for_user
from evaweb.episodes.reconcile import reconcile
from evaweb.plans.models import Plan
from evaweb.plans.services import freeze_plan, reveal_plan
from evaweb.trials.models import Checkpoint, Trial
from tests.evaweb.data_of_before.reading import HERE, MODELS, answers, restored, rows

EXPECTED = json.loads((HERE / "rows.json").read_text("utf-8")) if (HERE / "rows.json").exists() else {}


def _as_far(then, now):
    """What is said now, without what nobody asked for then."""
    if isinstance(then, dict):
        return {name: _as_far(value, now[name]) for name, value in then.items()}
    if isinstance(then, list) and len(then) == len(now):
        return [_as_far(*both) for both in zip(then, now, strict=True)]
    return now


@pytest.fixture
def report(monkeypatch, settings, tmp_path, db):
    return restored(monkeypatch, settings, tmp_path)


def test_nothing_is_lost(report):
    (problem,) = report.problems  # plans are in the database alone
    assert " of plan blocks v1, which is not in the database: " in problem
    assert report.restored == 38
    assert reconcile().restored == 0


def test_the_rows_are_as_they_were_then(report):
    all_rows = rows()
    for model in MODELS:
        expected, found = EXPECTED[model.__name__], all_rows[model.__name__]
        known = set(expected[0]) if expected else set()
        assert [{name: row[name] for name in known} for row in found] == [
            {name: row[name] for name in known} for row in expected
        ], model
        later = [model._meta.get_field(name) for name in found[0].keys() - known] if found else []
        for field in later:
            given = {json.dumps(row[field.name]) for row in found}
            assert given == {json.dumps(field.get_default())}, (model, field)


def test_the_api_says_what_it_said_then(report):
    """Once an administrator has frozen and revealed the plan that was lost; what was blind stays so until then."""
    rater, trials = User.objects.get(username="rita"), Trial.objects.filter(evaluation__kind="plan")
    assert trials
    assert all(visibility_for_user(rater).hides(trial) for trial in trials)
    adam, plan = User.objects.get(username="adam"), Plan.objects.get()
    Checkpoint.objects.update(active=True)
    reveal_plan(user=adam, plan=freeze_plan(user=adam, plan=plan))
    found = answers()
    assert _as_far(EXPECTED["trials"], found["trials"]) == EXPECTED["trials"]
    header = EXPECTED["csv"][0]
    chosen = [found["csv"][0].index(name) for name in header]
    assert chosen == sorted(chosen)
    assert [[row[at] for at in chosen] for row in found["csv"]] == EXPECTED["csv"]
