"""Blocks are sorted by colour as the instruction says, with contact forces and two arms."""

from __future__ import annotations

import pytest

from robots import Robot
from runtime.benches.schema import load_schema
from runtime.simulation.bench.bench import Bench
from runtime.simulation.contact.bench import ContactTabletop
from runtime.simulation.scripts.pick_place import Skill
from runtime.simulation.scripts.sorting import Sorting
from tests.runtime.simulation.bench_trial import RATE, ROBOT, Trial

SCHEMA = load_schema("sorting")
BENCH = Bench(SCHEMA)
RED, GREEN = BENCH.colour(0), BENCH.colour(3)


def sorting_table(robot: Robot, seed: int) -> ContactTabletop:
    return ContactTabletop(robot, seed, bench=BENCH)


@pytest.mark.parametrize(
    ("prompt", "targets"),
    [
        (SCHEMA.instruction, {RED: "blue_bin", GREEN: "purple_bin"}),
        ("Put the GREEN blocks into the blue bin.", {GREEN: "blue_bin"}),
        ("move all blocks to the purple bin", {RED: "purple_bin", GREEN: "purple_bin"}),
        ("place the red block in the purple bin", {RED: "purple_bin"}),
        ("put the block on the plate", {}),
        ("put the yellow blocks into the blue bin", {}),
        ("", {}),
    ],
)
def test_the_instruction_says_which_colour_goes_into_which_bin(prompt: str, targets: dict) -> None:
    assert Sorting(ROBOT, 50, RATE, Skill(), BENCH).targets(prompt) == targets


def test_five_blocks_are_sorted_with_both_arms() -> None:
    trial = Trial(Skill(), pose="ready", make=sorting_table, prompt=SCHEMA.instruction, bench="sorting").lay(
        3
    )
    outcome = trial.run(120.0)
    assert outcome.success, (outcome.milestones, outcome.seconds)
    assert {name for name, reached in outcome.milestones.items() if reached} == set(SCHEMA.success)


def test_a_part_of_the_task_leaves_the_rest_alone() -> None:
    prompt = "put the green blocks into the blue bin"
    trial = Trial(Skill(), pose="ready", make=sorting_table, prompt=prompt, bench="sorting").lay(1)
    before = trial.table.truth()["blocks"]
    outcome = trial.run(60.0)
    reached = {name for name, value in outcome.milestones.items() if value}
    assert reached == {"green_1_in_blue", "green_2_in_blue"}
    after = trial.table.truth()["blocks"]
    assert isinstance(before, list)
    assert isinstance(after, list)
    for red, now in zip(before[:3], after[:3], strict=True):
        assert now == pytest.approx(red, abs=2e-3)
