import pytest

from evaweb.plans.models import Plan
from evaweb.trials.models import Checkpoint
from tests.evaweb.trials import builders


@pytest.fixture(autouse=True)
def _data_dir(settings, tmp_path):
    settings.DATA_DIR = tmp_path


@pytest.fixture
def bench(db):
    return builders.bench()


@pytest.fixture
def owner(db):
    return builders.user("olga")


@pytest.fixture
def draft(bench, owner):
    """Two checkpoints at two positions of one scene, three times each: 12 trials."""
    plan = Plan.objects.create(
        name="blocks", title="Blocks", question="Is new better?", owner=owner, repetitions=3
    )
    other = Checkpoint.objects.create(name="pi0-new", policy={"url": "ws://127.0.0.1:8001"})
    plan.checkpoints.set([bench.checkpoint, other])
    plan.positions.set(bench.scene.positions.all())
    plan.first, plan.second = other, bench.checkpoint
    plan.save()
    return plan
