"""What was voided, repeated and corrected stands beside the headline, by checkpoint."""

import pytest

from evaweb.plans.allocation import allocate_trial
from evaweb.plans.services import close_plan, reveal_plan
from evaweb.results.analysis.integrity import checkpoint_changes
from evaweb.results.pages.pages import summary_page
from evaweb.results.presentation.plan_result import PlanResult
from evaweb.trials import services, voids
from tests.evaweb.trials import builders

NEW, OLD = "pi0-new", "pi0-block"


@pytest.fixture
def tried(bench, plan):
    """Makes the next trial and scores it."""

    def one(success, **said):
        trial = allocate_trial(user=bench.operator, station=bench.station, plan=plan).trial
        builders.finished_trial(trial, 9.0)
        ticks = bench.ticks(True, success, success)
        services.score_trial(user=bench.operator, trial=trial, milestones=ticks, **said)
        trial.refresh_from_db()
        return trial

    return one


@pytest.mark.exhaustive
def test_failures_of_one_checkpoint_that_were_voided_are_told_and_what_they_change(bench, plan, tried):
    voided, second = 0, builders.user("sam")
    for left in range(16, 0, -1):
        trial = tried(success=False)
        if trial.checkpoint.name == NEW and left > 1:  # the last one ends the plan
            voids.void_trial(user=bench.operator, trial=trial, reason="the plate had slipped")
            voids.answer_void(user=second, trial=trial, agree=True)
            tried(success=True)
            voided += 1
    found = {row.checkpoint: row for row in checkpoint_changes(plan)}
    assert (found[NEW].voided_failures, found[NEW].voided_successes, found[NEW].voided) == (voided, 0, voided)
    assert (found[OLD].voided, found[OLD].attempts, found[OLD].counted) == (0, 8, 8)
    assert (found[NEW].attempts, found[NEW].counted) == (8 + voided, 8)
    assert voided in (7, 8)
    said = PlanResult(plan).headline
    assert said.sentence.startswith(f"{NEW} succeeded more often than {OLD}: {voided}/8 against 0/8")
    assert said.at_first.startswith(f"No significant difference between {NEW} and {OLD}: 0/8 against 0/8")


@pytest.mark.exhaustive
def test_attempts_thrown_away_unscored_are_told_by_the_worst_that_they_could_have_been(bench, plan, tried):
    for left in range(16, 0, -1):
        thrown = allocate_trial(user=bench.operator, station=bench.station, plan=plan).trial
        new = thrown.checkpoint.name == NEW
        if new and left > 4:
            builders.finished_trial(thrown, 9.0)
            voids.void_trial(user=bench.operator, trial=thrown, reason="the plate had slipped")
        else:
            services.abandon_trial(user=bench.operator, trial=thrown)  # it never ran: it cannot have failed
        tried(success=new)
    said = PlanResult(plan).headline
    assert said.sentence.startswith(f"{NEW} succeeded more often than {OLD}: 8/8 against 0/8")
    assert said.worst.startswith(f"No significant difference between {NEW} and {OLD}: 2/8 against 0/8")
    assert said.at_first == ""


def test_where_nothing_was_voided_there_is_one_sentence(plan, tried):
    tried(success=True)
    assert PlanResult(plan).headline.at_first == ""


def test_corrections_are_told_by_their_direction_and_late_ones_apart(bench, plan, owner, tried):
    first, second = tried(success=True), tried(success=False)
    ticks = bench.ticks(True, False, False)
    services.score_trial(user=bench.operator, trial=first, milestones=ticks, reason="it had slipped off")
    close_plan(user=owner, plan=plan, reason="enough")
    reveal_plan(user=owner, plan=plan)
    ticks = bench.ticks(True, True, True)
    services.score_trial(user=bench.operator, trial=second, milestones=ticks, reason="seen on the video")
    plan.refresh_from_db()
    rows = {row.checkpoint: row for row in checkpoint_changes(plan)}
    one, other = rows[first.checkpoint.name], rows[second.checkpoint.name]
    assert (one.to_failure, one.to_success, one.late) == (1, 0, 0)
    assert (other.to_failure, other.to_success, other.late) == (0, 1, 1)
    assert len(one.operators) == len(one.stations) == 1


def test_the_page_says_that_the_plan_was_closed_as_soon_as_it_is(plan, owner, tried):
    def sentence():
        return summary_page(PlanResult(plan))["headline"].sentence

    tried(success=True)
    tried(success=False)
    assert "the design goes on" in sentence()
    close_plan(user=owner, plan=plan, reason="enough")
    assert "closed after 1 of 8 pairs, before the design ended" in sentence()
    assert [row.attempts for row in summary_page(PlanResult(plan))["changes"]] == [1, 1]
