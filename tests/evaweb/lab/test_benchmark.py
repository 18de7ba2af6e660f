"""The lab with a published benchmark: what it writes into the database before anybody is logged in."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from evaweb.lab.management.commands.benchmark import Command
from evaweb.lab.progress import silent
from evaweb.plans.models import Plan, PlanState
from evaweb.trials.models import Checkpoint, Position, Scene
from runtime.benches.schema import load_schema

pytestmark = pytest.mark.django_db


@pytest.mark.parametrize(
    ("bench", "tasks", "compared", "task", "instruction"),
    [
        ("metaworld", 50, 10, "push-v3", "push-v3"),
        ("aloha", 2, 2, "insertion", "Insert the peg into the socket."),
    ],
)
def test_its_tasks_are_scenes_and_its_experts_are_compared_blind(
    bench: str, tasks: int, compared: int, task: str, instruction: str
):
    started = []
    processes = SimpleNamespace(start=lambda program: {"url": "ws://127.0.0.1:1"})
    lab = SimpleNamespace(
        progress=silent(), processes=processes, start=lambda benches: started.extend(benches)
    )
    for _ in range(2):  # as at every start
        Command()._up(lab, bench, (96, 96))
    assert Scene.objects.count() == Position.objects.count() == tasks
    position = Position.objects.get(scene__name=f"{bench}-{task}")
    assert position.bench == {"choices": {"task": task, "pictures": "plain"}}
    assert position.scene.instruction == instruction
    schema = load_schema(bench)
    milestones = [(row.truth, row.required) for row in position.scene.milestones.order_by("order")]
    assert milestones == [(name, name in schema.success) for name in schema.milestones]
    assert Checkpoint.objects.count() == 4
    plan = Plan.objects.get()
    assert (plan.state, plan.blind, plan.positions.count()) == (PlanState.FROZEN, True, compared)
    assert [bench.deployment.name for bench in started] == 2 * [f"{bench}.toml"]
