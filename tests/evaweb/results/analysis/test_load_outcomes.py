import pytest

from evaweb.plans.allocation import allocate_trial
from evaweb.plans.models import Plan
from evaweb.plans.services import freeze_plan
from evaweb.results.analysis.analysis import analyse
from evaweb.results.analysis.load_outcomes import load_plan_outcomes
from evaweb.trials import services, voids
from evaweb.trials.models import Checkpoint
from tests.evaweb.trials import builders


@pytest.fixture(autouse=True)
def _data_dir(settings, tmp_path):
    settings.DATA_DIR = tmp_path


@pytest.fixture
def bench(db):
    return builders.bench()


@pytest.fixture
def plan(bench):
    made = Plan.objects.create(name="blocks", title="Blocks", owner=builders.user("olga"), repetitions=4)
    made.checkpoints.set([bench.checkpoint, Checkpoint.objects.create(name="pi0-new", policy={})])
    made.positions.set(bench.scene.positions.all())
    return freeze_plan(user=made.owner, plan=made)


def carry_out(bench, plan, n, success):
    for _ in range(n):
        trial = allocate_trial(user=bench.operator, station=bench.station, plan=plan).trial
        builders.finished_trial(trial, 10.0)
        ok = success(trial)
        services.score_trial(
            user=bench.operator,
            trial=trial,
            milestones=bench.ticks(True, ok, ok),
            failure="" if ok else "dropped",
        )


@pytest.mark.exhaustive
def test_outcomes_of_a_plan_are_what_was_scored_in_its_order(bench, plan):
    carry_out(bench, plan, 16, lambda trial: trial.checkpoint.name == "pi0-new")
    found = load_plan_outcomes(plan)
    assert [outcome.order for outcome in found] == list(range(1, 17))
    assert len({outcome.block for outcome in found}) == 8
    assert all(outcome.success == (outcome.checkpoint == "pi0-new") for outcome in found)
    assert found[0].labels == ("held", "lifted", "on the plate")
    assert {outcome.failure for outcome in found if not outcome.success} == {"dropped"}
    compared = analyse(found).comparisons[0]
    assert (compared.first, compared.pairs) == ("pi0-new", 8)


def test_a_correction_counts_and_a_void_does_not(bench, plan):
    carry_out(bench, plan, 4, lambda trial: True)
    first, second = (h.trial for h in plan.handouts.all()[:2])
    services.score_trial(
        user=bench.operator, trial=first, milestones=bench.ticks(True, False, False), reason="it fell later"
    )
    voids.void_trial(user=bench.operator, trial=second, reason="the camera had moved")
    found = {outcome.trial: outcome for outcome in load_plan_outcomes(plan)}
    assert not found[first.pk].success
    assert found[first.pk].milestones == (True, False, False)
    assert second.pk not in found


def test_the_number_of_queries_does_not_grow(bench, plan, django_assert_num_queries):
    carry_out(bench, plan, 2, lambda trial: True)
    with django_assert_num_queries(4):
        load_plan_outcomes(plan)
    carry_out(bench, plan, 6, lambda trial: False)
    with django_assert_num_queries(4):
        load_plan_outcomes(plan)
