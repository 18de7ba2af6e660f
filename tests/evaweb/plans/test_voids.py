"""A scored trial of a blind plan is voided by two blind operators, or not at all."""

from datetime import timedelta

import pytest
from django.db import IntegrityError, transaction
from django.utils import timezone

from evaweb.core.errors import Conflict, EvaError, NotAllowed
from evaweb.plans.allocation import allocate_trial, plan_progress
from evaweb.plans.blinding_rules import record_unblinding
from evaweb.plans.design import current_pairs, stored_blocks
from evaweb.plans.selectors import remaining
from evaweb.plans.services import amend_plan, close_plan, freeze_plan, reveal_plan
from evaweb.trials import services, voids
from evaweb.trials.models import Trial, VoidRequest
from tests.evaweb.trials import builders
from tests.evaweb.unguarded import without_triggers

WHY = "the plate had slipped"


@pytest.fixture
def plan(draft, owner):
    return freeze_plan(user=owner, plan=draft)


@pytest.fixture
def made(bench, plan):
    """Makes the next trial and scores it."""

    def make(success=False):
        trial = allocate_trial(user=bench.operator, station=bench.station, plan=plan).trial
        builders.finished_trial(trial, 9.0)
        services.score_trial(user=bench.operator, trial=trial, milestones=bench.ticks(True, success, success))
        trial.refresh_from_db()
        return trial

    return make


@pytest.fixture
def second(db):
    return builders.user("sam")


@pytest.fixture
def asked(bench, made):
    """A failure whose void the operator has asked for."""
    return voids.void_trial(user=bench.operator, trial=made(), reason=WHY)


def test_it_is_asked_for_repeated_and_voided_where_a_second_operator_agrees(bench, plan, made, asked, second):
    assert asked.status == "void_asked"
    again = made(success=True)
    assert (again.number, again.attempt) == (asked.number, asked.attempt + 1)
    assert voids.answer_void(user=second, trial=asked, agree=True).status == "voided"
    asked.refresh_from_db()
    assert (asked.reason, asked.voided_by) == (WHY, bench.operator)
    (row,) = asked.void_requests.all()
    assert (row.answer, row.answered_by, row.reason) == ("agreed", second, WHY)
    assert (remaining(plan), plan_progress(plan).counted) == (11, 1)


def test_a_refusal_has_it_count_and_not_its_repetition(plan, made, asked, second):
    again = made(success=True)
    with pytest.raises(EvaError, match="reason is empty"):
        voids.answer_void(user=second, trial=asked, agree=False)
    kept = voids.answer_void(user=second, trial=asked, agree=False, reason="it had not")
    assert (kept.status, kept.reason, kept.voided_by) == ("scored", "", None)
    again.refresh_from_db()
    assert (again.status, again.reason) == ("voided", voids.KEPT)
    assert (remaining(plan), plan_progress(plan).counted) == (11, 1)
    following = made()  # the slot has its trial: the next one is handed out
    assert following.handout.slot_id != asked.handout.slot_id


def test_neither_whoever_asked_nor_whoever_looked_answers(bench, plan, owner, asked):
    with pytest.raises(NotAllowed, match="another operator has to answer"):
        voids.answer_void(user=bench.operator, trial=asked, agree=True)
    record_unblinding(plan, owner)
    with pytest.raises(NotAllowed, match="an operator who is blind scores"):
        voids.answer_void(user=owner, trial=asked, agree=True)
    with pytest.raises(NotAllowed):
        voids.answer_void(user=builders.user("vic", "viewer"), trial=asked, agree=True)
    assert [voids.can_answer_void(asked, user) for user in (bench.operator, owner)] == [False, False]
    asked.refresh_from_db()
    assert asked.status == "void_asked"


def test_it_waits_for_the_end_of_a_repetition(bench, plan, asked, second):
    again = allocate_trial(user=bench.operator, station=bench.station, plan=plan).trial
    with pytest.raises(Conflict, match=f"trial {asked.pk} is being repeated, by trial {again.pk}"):
        voids.answer_void(user=second, trial=asked, agree=False, reason="it had not")
    with transaction.atomic():
        voids.lapse_void_requests(Trial.objects.all(), user=second, now=True)
    asked.refresh_from_db()
    assert asked.status == "void_asked"
    services.abandon_trial(user=bench.operator, trial=again)
    assert voids.answer_void(user=second, trial=asked, agree=False, reason="it had not").status == "scored"


def test_without_an_answer_it_counts_after_a_fortnight(made, asked, second):
    made(success=True)
    past = timezone.now() - voids.ANSWERED_WITHIN - timedelta(seconds=1)
    with without_triggers("trials"):
        asked.void_requests.update(at=past)
    assert not voids.can_answer_void(asked, second)
    with pytest.raises(Conflict, match="more than 14 days ago"):
        voids.answer_void(user=second, trial=asked, agree=True)
    made()
    asked.refresh_from_db()
    assert (asked.status, asked.void_requests.get().answer) == ("scored", "lapsed")


def test_without_an_answer_it_counts_at_the_reveal(bench, plan, owner, made, asked):
    again = made(success=True)
    made()
    before = current_pairs(plan)
    assert (before.counted[0] == before.at_first[0]) is False
    close_plan(user=owner, plan=plan, reason="enough")
    reveal_plan(user=owner, plan=plan)
    asked.refresh_from_db()
    again.refresh_from_db()
    assert (asked.status, again.status) == ("scored", "voided")
    plan.refresh_from_db()
    assert stored_blocks(plan) == before.at_first == current_pairs(plan).counted
    with pytest.raises(EvaError, match="with the result in view"):
        voids.void_trial(user=bench.operator, trial=asked, reason=WHY)


def test_it_is_asked_for_once_at_a_time(bench, asked, second):
    assert voids.void_trial(user=bench.operator, trial=asked, reason=WHY).status == "void_asked"
    assert VoidRequest.objects.count() == 1
    with pytest.raises(Conflict, match="was asked for already"):
        voids.void_trial(user=second, trial=asked, reason="another reason")
    with pytest.raises(Conflict, match="a second operator agrees or refuses"):
        services.score_trial(
            user=bench.operator, trial=asked, milestones=bench.ticks(True, True, True), reason="seen"
        )
    voids.answer_void(user=second, trial=asked, agree=False, reason="it had not")
    voids.void_trial(user=bench.operator, trial=asked, reason="look again")
    assert [row.answer for row in asked.void_requests.all()] == ["refused", ""]


def test_what_has_no_score_or_is_of_no_blind_plan_is_voided_at_once(bench, plan):
    trial = allocate_trial(user=bench.operator, station=bench.station, plan=plan).trial
    builders.finished_trial(trial, 9.0)
    assert voids.void_trial(user=bench.operator, trial=trial, reason=WHY).status == "voided"
    assert voids.void_trial(user=bench.operator, trial=bench.scored(), reason=WHY).status == "voided"


def test_an_answer_stays(asked, second):
    voids.answer_void(user=second, trial=asked, agree=True)
    row = VoidRequest.objects.filter(trial=asked)
    for change in ({"answer": "refused"}, {"reason": "x"}, {"answered_by": None}, {"answer_reason": "x"}):
        with pytest.raises(IntegrityError), transaction.atomic():
            row.update(**change)


# --- a repetition whose void is asked for as well ------------------------------------------------------------


@pytest.fixture
def both_asked(bench, made, asked):
    """The trial, its repetition, and the repetition of that; the voids of the first two are asked for."""
    again = voids.void_trial(user=bench.operator, trial=made(success=True), reason="it slipped again")
    return asked, again, made()


def states(*trials):
    for trial in trials:
        trial.refresh_from_db()
    return [trial.status for trial in trials]


def test_a_refusal_answers_for_the_repetitions_too(plan, owner, both_asked, second):
    first, again, third = both_asked
    voids.answer_void(user=second, trial=first, agree=False, reason="it had not")
    assert states(first, again, third) == ["scored", "voided", "voided"]
    assert (again.void_requests.get().answer, voids.can_answer_void(again, second)) == ("lapsed", False)
    close_plan(user=owner, plan=plan, reason="enough")
    reveal_plan(user=owner, plan=plan)
    assert states(first, again, third) == ["scored", "voided", "voided"]


@pytest.mark.parametrize("at", ["hand-out", "reveal"])
def test_none_of_them_is_answered_for_twice(plan, owner, made, both_asked, at):
    if at == "hand-out":
        with without_triggers("trials"):
            VoidRequest.objects.update(at=timezone.now() - voids.ANSWERED_WITHIN - timedelta(seconds=1))
        made()
    else:
        close_plan(user=owner, plan=plan, reason="enough")
        reveal_plan(user=owner, plan=plan)
    assert states(*both_asked) == ["scored", "voided", "voided"]
    assert set(VoidRequest.objects.values_list("answer", flat=True)) == {"lapsed"}


def test_one_attempt_of_a_slot_has_a_score_that_counts(bench, plan, asked, second):
    again = allocate_trial(user=bench.operator, station=bench.station, plan=plan).trial
    services.abandon_trial(user=bench.operator, trial=again)
    voids.answer_void(user=second, trial=asked, agree=False, reason="it had not")
    builders.finished_trial(again, 9.0)  # the answer to its run was lost: it ran after all
    with pytest.raises(Conflict, match=f"trial {asked.pk} counts in place of trial {again.pk}"):
        services.score_trial(user=bench.operator, trial=again, milestones=bench.ticks(True, True, True))
    assert voids.void_trial(user=bench.operator, trial=again, reason="the other counts").status == "voided"


def test_after_the_close_nothing_that_has_a_score_is_voided(bench, plan, owner, made):
    trial = made()
    close_plan(user=owner, plan=plan, reason="enough")
    with pytest.raises(Conflict, match=r"is closed: trial \d+ could not be repeated, so it counts"):
        voids.void_trial(user=bench.operator, trial=trial, reason=WHY)
    assert states(trial) == ["scored"]


def test_what_is_not_answered_when_the_next_version_is_frozen_counts(plan, owner, asked):
    amended = amend_plan(user=owner, plan=plan, reason="another lamp")
    assert states(asked) == ["void_asked"]
    freeze_plan(user=owner, plan=amended)
    assert (states(asked), asked.void_requests.get().answer) == (["scored"], "lapsed")


def test_what_the_bench_says_is_shown_once_the_trial_is_scored(bench, plan, client):
    trial = allocate_trial(user=bench.operator, station=bench.station, plan=plan).trial
    builders.finished_trial(trial, 9.0)
    Trial.objects.filter(pk=trial.pk).update(truth={"milestones": {"lifted": True}, "success": True})
    client.force_login(bench.operator)
    page = f"/result/trials/{trial.pk}/"
    assert "The simulated bench says" not in client.get(page).content.decode()
    services.score_trial(user=bench.operator, trial=trial, milestones=bench.ticks(True, True, True))
    assert "The simulated bench says" in client.get(page).content.decode()


def test_a_void_that_lapses_when_nothing_is_left_closes_the_plan(bench, plan, made):
    first, *_ = [made() for _ in range(11)]
    voids.void_trial(user=bench.operator, trial=first, reason=WHY)
    made()
    made()  # the repetition
    plan.refresh_from_db()
    assert plan.state == "frozen"  # it waits for the answer
    with without_triggers("trials"):
        VoidRequest.objects.update(at=timezone.now() - voids.ANSWERED_WITHIN - timedelta(seconds=1))
    with pytest.raises(Conflict, match="has ended: all pairs of its comparison are made"):
        allocate_trial(user=bench.operator, station=bench.station, plan=plan)
    plan.refresh_from_db()
    assert (plan.state, states(first)) == ("closed", ["scored"])


def test_an_answer_closes_a_plan_that_waits_for_nothing_else(bench, plan, made, second):
    first, *_ = [made() for _ in range(11)]
    voids.void_trial(user=bench.operator, trial=first, reason=WHY)
    made()
    made()
    voids.answer_void(user=second, trial=first, agree=True)
    plan.refresh_from_db()
    assert (plan.state, plan.closed_because) == (
        "closed",
        "all pairs of its comparison are made, after 6 pairs",
    )


def test_after_the_close_what_was_not_repeated_is_not_voided_by_an_answer(plan, owner, asked, second):
    close_plan(user=owner, plan=plan, reason="enough")
    with pytest.raises(Conflict, match="was not repeated, so it counts; refuse its void"):
        voids.answer_void(user=second, trial=asked, agree=True)
    assert voids.answer_void(user=second, trial=asked, agree=False, reason="it had not").status == "scored"
