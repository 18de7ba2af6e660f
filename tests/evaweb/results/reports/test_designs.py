"""The offline program comes to the same end of a design as the lab, and to the same error of its boundary."""

import random
from types import SimpleNamespace

import pytest

from evaweb.results.reports.recompute import designs as offline
from evaweb.statistics.designs import conclude, design, table

RULES = [
    ("none", "success", None),
    ("none", "score", None),
    ("none", "success", 0.2),
    ("evidence", "success", None),
    ("evidence", "score", None),
    ("late", "success", None),
    ("early", "success", 0.2),
]


def plan_of(found):
    said = {"rule": found.rule, "alpha": found.alpha, "outcome": found.outcome, "margin": found.margin}
    said["boundary"] = table(found.boundary) if found.boundary else None
    scenes = [{"name": "s", "positions": [{"number": 1}]}]
    return {"stopping": said, "comparison": ["a", "b"], "scenes": scenes, "repetitions": found.pairs}


@pytest.mark.parametrize(("rule", "outcome", "margin"), RULES)
def test_it_comes_to_the_same_end(rule, outcome, margin):
    found = design(rule=rule, pairs=30, alpha=0.05, outcome=outcome, margin=margin)
    chance, plan = random.Random(7), plan_of(found)
    for rates in ((0.5, 0.5), (0.2, 0.8), (0.9, 0.3)):
        for count in (0, 7, 30, 30, 30):
            draw = [float(chance.random() < rate) for rate in rates] if outcome == "success" else None
            pairs = [
                tuple(
                    float(chance.random() < rate) if draw else round(rate * chance.random(), 2)
                    for rate in rates
                )
                for _ in range(count)
            ]
            here, there = conclude(found, pairs), offline.conclusion(pairs, plan)
            winner = {"first": "a", "second": "b", None: None}[here.winner]
            assert (there["pairs"], there["at"], there["winner"]) == (here.pairs, here.at, winner)
            assert there["p"] == (here.p and pytest.approx(here.p, rel=1e-6))


@pytest.mark.parametrize(("rule", "margin"), [("late", None), ("early", None), ("late", 0.15)])
def test_it_counts_the_same_error(rule, margin):
    found = design(rule=rule, pairs=25, alpha=0.05, margin=margin)
    highest, bound = found.boundary.error()
    counted = offline.error(plan_of(found))
    assert (
        highest - 1e-4 <= counted <= 0.05
    )  # neither bound is nearer than it takes to say that it is below alpha
    assert highest <= bound <= 0.05


@pytest.mark.parametrize("alpha", [0.0001, 0.01, 0.1])
@pytest.mark.parametrize(("rule", "pairs"), [("late", 21), ("late", 44), ("early", 20), ("early", 45)])
def test_what_is_below_alpha_is_found_to_be(rule, pairs, alpha):
    found = design(rule=rule, pairs=pairs, alpha=alpha)
    assert found.boundary.error()[1] <= alpha
    assert offline.error(plan_of(found)) <= alpha


def test_a_boundary_that_stops_too_often_is_found():
    plan = plan_of(design(rule="early", pairs=20, alpha=0.05))
    plan["stopping"]["boundary"] = [[n, m, 0, (n + 1) // 2] for n, m, *_ in plan["stopping"]["boundary"]]
    assert offline.error(plan) > 0.2


def test_pairs_enter_by_their_block_up_to_the_first_that_is_not_made():
    plan = plan_of(design(rule="none", pairs=4, alpha=0.05))

    def row(block, checkpoint, status="scored"):
        return SimpleNamespace(
            block=block, checkpoint=checkpoint, status=status, success=checkpoint == "a", score=1.0
        )

    made = [
        row("2", "a"),
        row("2", "b"),
        row("0", "b"),
        row("0", "a"),
        row("1", "a"),
        row("1", "b", "voided"),
    ]
    assert offline.pairs_of(made, plan) == [(1.0, 0.0)]
    made.append(row("1", "b"))
    assert offline.pairs_of(made, plan) == [(1.0, 0.0)] * 3
