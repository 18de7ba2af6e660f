import pytest
from django.contrib.auth.models import User

from evaweb.episodes.folders import preview_folder
from evaweb.plans.allocation import allocate_trial
from evaweb.plans.models import Plan
from evaweb.plans.services import freeze_plan, reveal_plan
from evaweb.results.analysis import caching
from evaweb.stations.models import Station
from evaweb.trials import services
from evaweb.trials.models import Checkpoint, Scene
from tests.evaweb.played import played
from tests.evaweb.trials import builders


@pytest.fixture(autouse=True)
def _alone(settings, tmp_path):
    settings.DATA_DIR = tmp_path
    caching.clear_caches()


@pytest.fixture
def bench(db):
    played("bench", builders.bench)
    return builders.TrialBench(
        Station.objects.get(), Scene.objects.get(), Checkpoint.objects.get(), User.objects.get(username="ann")
    )


@pytest.fixture
def owner(bench):
    played("owner", lambda: builders.user("olga"))
    return User.objects.get(username="olga")


@pytest.fixture
def plan(bench, owner):
    """Two checkpoints at two positions, four times each: 16 trials, blind, not begun."""
    played("plan", lambda: _frozen(bench, owner))
    return Plan.objects.get()


def _frozen(bench, owner):
    other = Checkpoint.objects.create(name="pi0-new", policy={})
    made = Plan.objects.create(
        name="blocks",
        title="Blocks",
        question="Is new better?",
        owner=owner,
        repetitions=4,
        second_rater_share=0.5,
        first=other,
        second=bench.checkpoint,
    )
    made.checkpoints.set([bench.checkpoint, other])
    made.positions.set(bench.scene.positions.all())
    freeze_plan(user=owner, plan=made)


@pytest.fixture
def carry_out(bench):
    """Makes the next trials of a plan; the new checkpoint succeeds three times of four, the old one once of four."""

    def carry(plan, n, pictures=True):
        played(("carried out", plan.pk, n, pictures), lambda: _carried_out(bench, plan, n, pictures))

    return carry


def _carried_out(bench, plan, n, pictures):
    for _ in range(n):
        trial = allocate_trial(user=bench.operator, station=bench.station, plan=plan).trial
        new = trial.checkpoint.name == "pi0-new"
        ok = (trial.number + trial.position.number) % 4 != 0 if new else trial.number == 1
        smooth = -5.0 - 0.1 * trial.number if trial.number > 1 else None  # the first of each was not measured
        facts = {"smoothness": smooth, "smoothness_commanded": smooth and smooth + 0.5 * new}
        facts |= {"cameras": ["top"] if pictures else []}
        builders.finished_trial(trial, 8.0 + trial.number + 0.25 * new, **facts)
        if pictures:
            preview_folder(trial.episode_id).mkdir(parents=True)  # it can be watched
        services.score_trial(
            user=bench.operator,
            trial=trial,
            milestones=bench.ticks(True, ok or new, ok),
            failure="" if ok else "=dropped",
        )


@pytest.fixture
def revealed(plan, owner, carry_out):
    """All of it carried out, which closes it, and revealed."""
    carry_out(plan, 16)
    played("revealed", lambda: reveal_plan(user=owner, plan=plan))
    return Plan.objects.get()
