"""The offline program comes to the same end of a design as the lab, and to the same error of its boundary."""

import random
from types import SimpleNamespace

import pytest

from evaweb.results.reports.recompute import designs as offline
from evaweb.statistics.designs import boundary_table, design, estimated, findings, in_blocks

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
    said["boundary"] = boundary_table(found.boundary) if found.boundary else None
    said |= {"drops": found.drops, "counts": found.counts}
    scenes = [{"name": "s", "positions": [{"number": 1}]}]
    compared = [["abc"[first], "abc"[second]] for first, second in found.comparisons]
    whole = {"stopping": said, "comparisons": compared, "scenes": scenes, "repetitions": found.blocks}
    return whole | {"format": 6 if found.holm else 5}


def same_end(found, blocks):
    """The offline program's end is that of the lab, comparison by comparison."""
    here, there = findings(found, blocks), offline.conclusions(blocks, plan_of(found))
    for one, other, sides in zip(here.each, there, found.comparisons, strict=True):
        winner = {"first": "abc"[sides[0]], "second": "abc"[sides[1]], None: None}[one.winner]
        assert (other["blocks"], other["at"], other["winner"]) == (one.blocks, one.ended_at_pair, winner)
        assert other["p"] == (one.p and pytest.approx(one.p, rel=1e-6))
        said = estimated(found, blocks, sides, one)
        ends = said and [said.value, said.interval.low, said.interval.high]
        assert other["estimate"] == (ends and pytest.approx(ends, abs=1e-9))


@pytest.mark.parametrize(("rule", "outcome", "margin"), RULES)
def test_it_comes_to_the_same_end(rule, outcome, margin):
    found = design(rule=rule, blocks=30, alpha=0.05, outcome=outcome, margin=margin)
    chance = random.Random(7)
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
            same_end(found, in_blocks(pairs))


@pytest.mark.parametrize("drops", [False, True])
@pytest.mark.parametrize(("rule", "margin"), [("evidence", None), ("late", None), ("early", 0.2)])
@pytest.mark.parametrize("comparisons", [((0, 1), (0, 2), (1, 2)), ((0, 1), (2, 1))])
def test_it_comes_to_the_same_ends_of_several_comparisons(rule, margin, drops, comparisons):
    found = design(rule=rule, blocks=24, alpha=0.05, margin=margin, comparisons=comparisons, drops=drops)
    chance = random.Random(11)
    for rates in ((0.5, 0.5, 0.5), (0.1, 0.9, 0.5), (0.9, 0.8, 0.1)):
        for _ in range(3):
            blocks = [
                [(arm, float(chance.random() < rate)) for arm, rate in enumerate(rates)] for _ in range(24)
            ]
            del blocks[chance.randrange(15, 24)][chance.randrange(3)]
            same_end(found, blocks)


@pytest.mark.parametrize("outcome", ["success", "score"])
def test_it_comes_to_the_same_ends_of_several_comparisons_step_by_step(outcome):
    found = design(
        rule="none", blocks=20, alpha=0.05, outcome=outcome, comparisons=((0, 1), (0, 2), (1, 2)), holm=True
    )
    chance = random.Random(13)
    for rates in ((0.5, 0.5, 0.5), (0.1, 0.9, 0.5), (0.9, 0.55, 0.2), (0.9, 0.5, 0.45)):
        for _ in range(3):
            blocks = [
                [(arm, float(chance.random() < rate)) for arm, rate in enumerate(rates)] for _ in range(20)
            ]
            same_end(found, blocks)
            same_end(found, blocks[:12])


@pytest.mark.parametrize(("rule", "margin"), [("none", None), ("none", 0.3), ("late", None), ("early", 0.3)])
def test_it_comes_to_the_same_end_of_two_in_random_order(rule, margin):
    chance = random.Random(12)
    for rates in ((0.5, 0.5), (0.2, 0.9), (0.95, 0.9)):
        arms = [[chance.randrange(2), chance.randrange(2)] for _ in range(25)]
        drawn = [arm for of in arms for arm in of]
        counts = [(drawn[: 2 * at].count(0), drawn[: 2 * at].count(1)) for at in range(1, 26)]
        found = design(rule=rule, blocks=25, alpha=0.05, margin=margin, counts=counts)
        blocks = [[(arm, float(chance.random() < rates[arm])) for arm in of] for of in arms]
        same_end(found, blocks)
        same_end(found, blocks[:20])


@pytest.mark.parametrize(("rule", "margin"), [("late", None), ("early", None), ("late", 0.15)])
def test_it_counts_the_same_error(rule, margin):
    found = design(rule=rule, blocks=25, alpha=0.05, margin=margin)
    highest, bound = found.boundary.error()
    counted = offline.error(plan_of(found))
    assert (
        highest - 1e-4 <= counted <= 0.05
    )  # neither bound is nearer than it takes to say that it is below alpha
    assert highest <= bound <= 0.05


@pytest.mark.some(3)
@pytest.mark.parametrize("alpha", [0.0001, 0.01, 0.1])
@pytest.mark.parametrize(("rule", "pairs"), [("late", 21), ("late", 44), ("early", 20), ("early", 45)])
def test_what_is_below_alpha_is_found_to_be(rule, pairs, alpha):
    found = design(rule=rule, blocks=pairs, alpha=alpha)
    assert found.boundary.error()[1] <= alpha
    assert offline.error(plan_of(found)) <= alpha


def test_a_boundary_that_stops_too_often_is_found():
    plan = plan_of(design(rule="early", blocks=20, alpha=0.05))
    plan["stopping"]["boundary"] = [[n, m, 0, (n + 1) // 2] for n, m, *_ in plan["stopping"]["boundary"]]
    assert offline.error(plan) > 0.2


WON = [(0, 1.0), (1, 0.0)]


def test_pairs_enter_by_their_block_up_to_the_first_that_is_not_made():
    plan = plan_of(design(rule="none", blocks=4, alpha=0.05))

    def row(block, checkpoint, status="scored"):
        return SimpleNamespace(
            block=block,
            slot=2 * int(block) + (checkpoint == "b"),
            checkpoint=checkpoint,
            status=status,
            success=checkpoint == "a",
            score=1.0,
        )

    made = [
        row("2", "a"),
        row("2", "b"),
        row("0", "b"),
        row("0", "a"),
        row("1", "a"),
        row("1", "b", "voided"),
    ]
    assert offline.blocks_of(made, plan) == [WON] * 1
    made.append(row("1", "b"))
    assert offline.blocks_of(made, plan) == [WON] * 3
