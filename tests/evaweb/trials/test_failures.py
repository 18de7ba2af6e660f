"""The taxonomy of failures: what is offered, what a score may say, and that what was said stays."""

import json
from importlib import import_module

import pytest
from django.core.exceptions import ValidationError
from django.test import Client

from evaweb.core.errors import EvaError
from evaweb.trials import services, voids
from evaweb.trials.failures import failure_choices, ordered_terms
from evaweb.trials.models import FailureTerm, Milestone, Score, Trial
from evaweb.trials.record import JUDGEMENTS
from tests.evaweb.trials import builders

SAID = {"failure_phase": "grasp", "failure": "dropped"}


@pytest.fixture
def terms(db):
    return builders.failure_terms()


@pytest.fixture
def admin(bench):
    made = Client()
    made.force_login(builders.user("root", "admin"))
    return made


def score(bench, trial, success=False, **given):
    ticks = bench.ticks(True, success, success)
    return services.score_trial(**{"user": bench.operator, "trial": trial, "milestones": ticks, **given})


def words(levels):
    return {level.field: [choice.words for choice in level.choices] for level in levels}


def test_what_a_lab_begins_with_is_a_valid_taxonomy(db):
    FailureTerm.objects.all().delete()
    rows = import_module("evaweb.trials.migrations.0007_failures").TERMS
    for order, (level, text, key) in enumerate(rows):
        term = FailureTerm(level=level, words=text, key=key, order=order)
        term.full_clean()
        term.save()
    found = failure_choices()
    assert [(level.field, len(level.choices)) for level in found] == [("failure_phase", 5), ("failure", 8)]
    assert all(choice.key for level in found for choice in level.choices)


def test_a_failure_is_kept_with_its_phase_and_cause_in_the_row_and_on_the_disk(bench, terms):
    trial = bench.ended()
    row = score(bench, trial, **SAID)
    assert (row.failure_phase, row.failure, row.why) == ("grasp", "dropped", "grasp: dropped")
    (line,) = map(json.loads, JUDGEMENTS.path(trial.episode_id).read_text("utf-8").splitlines())
    assert {name: line[name] for name in SAID} == SAID
    assert score(bench, trial, **SAID) == row, "its answer was lost"
    assert Score.objects.count() == 1


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"failure_phase": "Grasp"}, "failure_phase = 'Grasp'; allowed: approach, grasp"),
        ({"failure_phase": "retired"}, "failure_phase = 'retired'; allowed: approach, grasp"),
        ({"failure_phase": "dropped"}, "failure_phase = 'dropped'; allowed: approach, grasp"),
        ({**SAID, "failure": "slipped"}, "failure = 'slipped'; allowed: missed, dropped"),
        ({"failure_phase": "x" * 61}, "failure_phase has 61 characters; allowed: at most 60"),
        ({"success": True, **SAID}, "failure_phase = 'grasp' but the trial is a success"),
    ],
)
def test_a_phase_is_one_of_the_labs_and_a_success_has_none(bench, terms, given, sentence):
    given = dict(given)
    with pytest.raises(EvaError, match=sentence):
        score(bench, bench.ended(), given.pop("success", False), **given)
    assert Score.objects.count() == 0


def test_a_cause_alone_may_be_in_words_of_before(bench, terms):
    assert score(bench, bench.ended(), failure="slipped").why == "slipped"


def test_a_scene_may_want_both_of_whoever_scores_and_of_no_bench(bench, terms):
    bench.scene.failure_required = True
    bench.scene.save()
    for given, field in (({"failure": "dropped"}, "failure_phase"), ({"failure_phase": "grasp"}, "failure")):
        with pytest.raises(EvaError, match=f"{field} is missing: scene block-on-plate wants it"):
            score(bench, trial := bench.ended(), **given)
        voids.void_trial(user=bench.operator, trial=trial, reason="of this test")
    said_by_bench = bench.ended()
    names = ("held", "lifted", "on_plate")
    for order, name in enumerate(names, 1):
        Milestone.objects.filter(order=order).update(truth=name)
    truth = {"milestones": {name: name == "held" for name in names}}
    Trial.objects.filter(pk=said_by_bench.pk).update(truth=truth)
    assert score(bench, said_by_bench, source="truth").why == ""
    assert score(bench, bench.ended(), success=True).success is True
    FailureTerm.objects.all().delete()
    assert score(bench, bench.ended()).why == "", "a lab without words asks for none"


def test_what_was_said_stays_whatever_becomes_of_the_words(bench, terms, admin):
    trial = bench.ended()
    before = score(bench, trial, **SAID)
    phase, cause = FailureTerm.objects.get(words="grasp"), FailureTerm.objects.get(words="dropped")
    form = {"words": "grip", "key": "g", "order": "1", "active": "on"}
    answer = admin.post(f"/admin/trials/failureterm/{phase.pk}/change/", form, follow=True)
    assert "1 score said &#x27;grasp&#x27; and keep it" in answer.content.decode()
    cause.active = False
    cause.save()
    assert words(failure_choices()) == {"failure_phase": ["approach", "grip"], "failure": ["missed"]}
    before.refresh_from_db()
    assert before.why == "grasp: dropped"
    said = {name: getattr(before, name) for name in SAID}
    assert words(failure_choices(said)) == {
        "failure_phase": ["approach", "grip", "grasp"],
        "failure": ["missed", "dropped"],
    }
    assert score(bench, trial, reason="the note", note="seen again", **SAID).why == "grasp: dropped"
    assert "dropped" in ordered_terms()["failure"], "a table has it where it was"


def test_no_two_have_a_key_or_the_same_words(terms):
    with pytest.raises(ValidationError, match="Another phase or cause has this key"):
        FailureTerm(level="cause", words="stuck", key="g").full_clean()
    with pytest.raises(ValidationError, match="There is one of these words already"):
        FailureTerm(level="cause", words="Dropped").full_clean()
    for key in "s1?":
        with pytest.raises(ValidationError, match="was given; allowed: one of a b c"):
            FailureTerm(level="cause", words="stuck", key=key).full_clean()
    FailureTerm(level="phase", words="dropped").full_clean()
    FailureTerm(level="cause", words="stuck").full_clean()


@pytest.mark.parametrize(
    "given", ["not said", "Not specified", " dropped ", "dropped\n", "drop\nped", "drop\x00ped"]
)
def test_words_that_would_be_taken_for_others_are_no_term(terms, given):
    for level in FailureTerm.Level.values:
        with pytest.raises(ValidationError, match="allowed: "):
            FailureTerm(level=level, words=given).full_clean()


def test_a_score_does_not_say_that_nothing_was_said(bench, terms):
    with pytest.raises(EvaError, match="failure = 'Not said'; allowed: other words, or none"):
        score(bench, bench.ended(), failure=" Not said ")
    assert Score.objects.count() == 0


def test_an_administrator_adds_a_cause(admin, terms):
    form = {"level": "cause", "words": "spilled", "key": "z", "order": "9", "active": "on"}
    assert admin.post("/admin/trials/failureterm/add/", form).status_code == 302
    assert failure_choices()[1].choices[-1].words == "spilled"
    assert "Shift + Z" in admin.get("/admin/trials/failureterm/").content.decode()
