"""Scoring, voiding, closing and revealing at one moment: each is before or after the other."""

import pytest

from evaweb.core.errors import Conflict, EvaError
from evaweb.plans import services as plans
from evaweb.plans.allocation import allocate_trial
from evaweb.plans.design import counted_now, current_pairs, stored_blocks
from evaweb.plans.models import Plan, PlanState
from evaweb.plans.services import close_plan, freeze_plan, reveal_plan
from evaweb.trials import services, voids
from evaweb.trials.models import Score, Trial, VoidRequest
from tests.evaweb.core.test_write_conflicts import at_once
from tests.evaweb.trials import builders

WHY = "the plate had slipped"


@pytest.fixture
def lab(transactional_db):
    """Real transactions, each thread with a connection of its own."""


@pytest.fixture
def plan(lab, draft, owner):
    return freeze_plan(user=owner, plan=draft)


@pytest.fixture
def bob(lab):
    return builders.user("bob")


def score(bench, trial, success, **said):
    ticks = bench.ticks(True, success, success)
    return services.score_trial(user=bench.operator, trial=trial, milestones=ticks, **said)


def tried_once(bench, plan, success=False):
    trial = allocate_trial(user=bench.operator, station=bench.station, plan=plan).trial
    builders.finished_trial(trial, 9.0)
    score(bench, trial, success)
    return Trial.objects.get(pk=trial.pk)


@pytest.fixture
def failed(bench, plan):
    """The last of four trials, all failures."""
    return [tried_once(bench, plan) for _ in range(4)][-1]


def said(found):
    """What was refused, of what was done at once; a fault that is no refusal fails the test."""
    refused = [one for one in found if isinstance(one, BaseException)]
    assert all(isinstance(one, EvaError) for one in refused), refused
    return refused


def require_whole(plan):
    """What the reveal kept is what counts, or what counted before later corrections, which are told."""
    plan = Plan.objects.get(pk=plan.pk)
    assert plan.state == PlanState.REVEALED
    assert not VoidRequest.objects.filter(answer="").exists()
    later = Score.objects.filter(trial__evaluation=plan.evaluation_id, scored_at__gt=plan.revealed_at)
    if later.exists():
        assert all(row.reason for row in later)
        assert stored_blocks(plan) == current_pairs(plan).at_first
    else:
        assert {name: plan.at_reveal[name] for name in ("blocks", "arms")} == counted_now(plan)


@pytest.fixture(params=["correction", "refusal"])
def act(request, bench, plan, owner, failed, bob):
    """What is done beside the reveal of the closed plan."""
    if request.param == "refusal":
        voids.void_trial(user=bench.operator, trial=failed, reason=WHY)
        tried_once(bench, plan, success=True)  # again
    close_plan(user=owner, plan=plan, reason="enough")
    if request.param == "refusal":
        return lambda: voids.answer_void(user=bob, trial=failed, agree=False, reason="it had not")
    return lambda: score(bench, failed, True, reason="the wrong key")


def test_what_is_said_at_the_moment_of_the_reveal_is_before_it_or_after_it(plan, owner, act):
    said(at_once(act, lambda: reveal_plan(user=owner, plan=plan)))
    require_whole(plan)


def test_what_is_said_while_a_reveal_is_worked_out_is_in_it(plan, owner, act, monkeypatch):
    revealed, before = plans._revealed, counted_now(plan)

    def meanwhile(*given):
        act()
        return revealed(*given)

    monkeypatch.setattr(plans, "_revealed", meanwhile)
    reveal_plan(user=owner, plan=plan)
    require_whole(plan)
    assert counted_now(plan) != before


def test_of_a_correction_and_a_void_at_one_moment_one_waits_for_the_other(bench, plan, failed, bob):
    found = at_once(
        lambda: score(bench, failed, True, reason="the wrong key"),
        lambda: voids.void_trial(user=bob, trial=failed, reason=WHY),
    )
    refused = said(found)
    failed.refresh_from_db()
    assert (failed.status, failed.void_requests.count()) == ("void_asked", 1)
    assert failed.scores.count() == 2 - len(refused)


def test_two_voids_of_one_trial_are_one_question(bench, plan, failed, bob):
    found = at_once(
        *[
            lambda user=user: voids.void_trial(user=user, trial=failed, reason=WHY)
            for user in (bench.operator, bob)
        ]
    )
    assert [type(one) for one in said(found)] == [Conflict]
    assert failed.void_requests.count() == 1


def test_a_score_given_twice_at_one_moment_is_one(bench, plan):
    trial = allocate_trial(user=bench.operator, station=bench.station, plan=plan).trial
    builders.finished_trial(trial, 9.0)
    assert not said(at_once(*[lambda: score(bench, trial, True)] * 4))
    assert trial.scores.count() == 1


def test_a_score_at_the_moment_of_the_close_counts(bench, plan, owner):
    trial = allocate_trial(user=bench.operator, station=bench.station, plan=plan).trial
    builders.finished_trial(trial, 9.0)
    found = at_once(
        lambda: score(bench, trial, True), lambda: close_plan(user=owner, plan=plan, reason="enough")
    )
    if said(found):  # it came first, and waits for the score
        close_plan(user=owner, plan=plan, reason="enough")
    trial.refresh_from_db()
    assert trial.status == "scored"
    reveal_plan(user=owner, plan=plan)
    require_whole(plan)


def test_two_stations_that_ask_at_one_moment_get_two_slots(bench, plan):
    other = builders.Station.objects.create(name="bench-2", robot="agilex_piper", simulated=True, boot="b")
    users = bench.operator, builders.user("bob")
    asks = [
        lambda user=user, station=station: allocate_trial(user=user, station=station, plan=plan)
        for user, station in zip(users, (bench.station, other), strict=True)
    ]
    found = at_once(*asks)
    assert not said(found)
    assert len({one.slot_id for one in found}) == 2
