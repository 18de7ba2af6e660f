"""What second raters and those who prefer have said comes back from the disk."""

import json

import pytest

from evaweb.episodes.folders import scores_file
from evaweb.episodes.publishing import success_of
from evaweb.episodes.reconcile import reconcile
from evaweb.plans.models import Plan
from evaweb.records.journal import read_numbered_lines
from evaweb.results.analysis.agreement import preference_ranking, rater_agreement
from evaweb.results.models import Preference, Rating
from evaweb.results.ratings import rating_queue
from tests.evaweb.trials import builders
from tests.evaweb.unguarded import without_triggers


@pytest.fixture
def rater(db):
    return builders.user("rita")


@pytest.fixture
def judged(plan, carry_out, rater, bench):
    """Two trials rated again, one pair compared."""
    carry_out(plan, 16)
    builders.failure_terms()
    for reached in (True, False):
        handout = rating_queue.next_to_rate(rater).found
        ticks = bench.ticks(True, reached, reached)
        said = {} if reached else {"failure": "dropped", "failure_phase": "grasp"}
        rating_queue.save_rating(
            user=rater, plan=plan, code=handout.code, milestones=ticks, note="wölbt sich", **said
        )
    pair = rating_queue.next_to_compare(rater).found
    codes = {"first": pair.first.code, "second": pair.second.code}
    rating_queue.save_preference(user=rater, plan=plan, outcome="second", why="sanfter ⟂", **codes)
    return plan


def rows():
    return [list(model.objects.order_by("at").values()) for model in (Rating, Preference)]


def lose():
    with without_triggers("results"):
        Rating.objects.all().delete()
        Preference.objects.all().delete()


def without_ids(found):
    return [[{**row, "id": None} for row in of_one] for of_one in found]


def test_they_come_back_as_they_were_once(judged):
    before, said = rows(), (rater_agreement(judged), preference_ranking(judged))
    lose()
    assert reconcile().restored == 3
    assert without_ids(rows()) == without_ids(before)
    assert (rater_agreement(judged), preference_ranking(judged)) == said
    assert reconcile().restored == 0


def test_what_the_database_has_is_left_alone(judged):
    before = rows()
    assert reconcile().restored == 0
    assert rows() == before


def test_a_line_whose_row_was_never_made_is_taken_unless_the_same_was_said_again(judged):
    rating = Rating.objects.order_by("pk").first()
    file = scores_file(rating.trial.episode_id)
    line = next(row for _, text in read_numbered_lines(file) if (row := json.loads(text))["kind"] == "rating")
    again = {**line, "uuid": "9d0f5b41-3d2c-4a27-8a4e-8ed4e7d3b0aa"}
    with file.open("a") as lines:
        lines.write(json.dumps(again) + "\n")
    assert reconcile().restored == 0
    assert Rating.objects.filter(trial=rating.trial).count() == 1


def test_a_preference_whose_plan_is_lost_stays_with_its_trials(judged, monkeypatch):
    lose()
    monkeypatch.setattr(
        "evaweb.results.ratings.restoring.Plan.objects.filter", lambda **key: Plan.objects.none()
    )
    assert reconcile().restored == 3
    assert Preference.objects.get().plan is None


def test_a_second_rating_is_no_score(judged):
    """Neither what is published nor what counts takes it for one."""
    for rating in Rating.objects.select_related("trial__verdict"):
        assert success_of(scores_file(rating.trial.episode_id)) == rating.trial.verdict.success


def test_a_line_that_is_none_is_named(judged):
    file = scores_file(Rating.objects.order_by("pk").first().trial.episode_id)
    with file.open("a") as lines:
        lines.write('{"kind": "rating", "uuid": "no"}\n')
    problems = reconcile().problems
    assert any(": rating.uuid is 'no'" in problem for problem in problems), problems
