"""The lab with Meta-World: what it writes into the database before anybody is logged in."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from evaweb.lab.management.commands.metaworld import Command
from evaweb.lab.progress import silent
from evaweb.plans.models import Plan, PlanState
from evaweb.trials.models import Checkpoint, Position, Scene

pytestmark = pytest.mark.django_db


def test_its_tasks_are_scenes_and_its_experts_are_compared_blind():
    started = []
    processes = SimpleNamespace(start=lambda program: {"url": "ws://127.0.0.1:1"})
    lab = SimpleNamespace(
        progress=silent(), processes=processes, start=lambda benches: started.extend(benches)
    )
    for _ in range(2):  # as at every start
        Command()._up(lab, (96, 96))
    assert Scene.objects.count() == Position.objects.count() == 50
    assert Position.objects.get(scene__name="metaworld-push-v3").bench == {
        "choices": {"task": "push-v3", "pictures": "plain"}
    }
    assert Checkpoint.objects.count() == 4
    plan = Plan.objects.get()
    assert (plan.state, plan.blind, plan.positions.count()) == (PlanState.FROZEN, True, 10)
    assert [bench.deployment.name for bench in started] == 2 * ["metaworld.toml"]
