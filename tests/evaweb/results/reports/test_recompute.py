"""Two ways to every number, written apart: the lab's own, and that of the report's program."""

import json
import random

import pytest

from evaweb.results.analysis.agreement import agreement, by_text
from evaweb.results.analysis.analysis import analyse
from evaweb.results.analysis.comparison import Verdict
from evaweb.results.analysis.outcomes import Interruption, Outcome
from evaweb.results.reports.recompute import judged, methods
from evaweb.results.reports.recompute.__main__ import differences
from evaweb.results.reports.recompute.numbers import Trial, numbers
from evaweb.statistics.confidence_sequence import confidence_sequence
from evaweb.statistics.multiple_comparisons import holm, letters
from evaweb.statistics.preference import Comparison, NotIdentifiedError, preferences
from evaweb.statistics.raters import cohen_kappa, gwet_ac1, krippendorff_alpha
from evaweb.statistics.sequential import score_evidence


def outcomes(checkpoints, n, scenes, seed):
    chance, found, block = random.Random(seed), [], -1
    while len(found) < n:
        scene, position, block = chance.randrange(scenes), chance.randint(1, 3), block + 1
        for name in chance.sample(range(checkpoints), checkpoints):
            ok = chance.random() < 0.4 + 0.15 * name
            reached = (True, ok or chance.random() < 0.5, ok)
            found.append(
                Outcome(
                    len(found),
                    len(found),
                    str(block),
                    f"c{name}",
                    f"s{scene}",
                    position,
                    ok,
                    sum(reached) / 3,
                    chance.choice((10.0, 12.5, chance.uniform(5, 40))) if chance.random() < 0.95 else None,
                    reached,
                    "" if ok else chance.choice("ab"),
                    labels=("one", "two", "three"),
                    smoothness=-chance.uniform(2, 9) if chance.random() < 0.8 else None,
                    commanded=-3.0 if name == 0 else -chance.uniform(2, 9),
                    operator=chance.choice(("ann", "bob")),
                    station=f"bench-{scene}",
                    failure_phase="" if ok else chance.choice(["", "grasp", "place"]),
                )
            )
    return found


def as_rows(runs):
    return [
        Trial(
            r.order,
            r.block,
            r.order,
            r.checkpoint,
            r.scene,
            r.position,
            "scored",
            r.success,
            r.score,
            r.duration,
            r.failure,
            tuple(zip(r.labels, r.milestones, strict=True)),
            r.smoothness,
            r.commanded,
            r.failure_phase,
            r.operator,
            r.station,
        )
        for r in runs
    ]


@pytest.mark.some(1)
@pytest.mark.parametrize(
    ("checkpoints", "n", "scenes", "seed"),
    [(2, 80, 2, 1), (3, 45, 1, 2), (4, 40, 3, 3), (2, 2, 1, 4), (1, 5, 2, 5)],
)
def test_both_ways_come_to_the_same(checkpoints, n, scenes, seed):
    runs = outcomes(checkpoints, n, scenes, seed)
    if seed in (1, 3):  # one is to be repeated: what came later is no evidence yet
        runs = [run for run in runs if (run.block, run.checkpoint) != ("6", "c0")]
    planned = {1: [], 4: [("c3", "c0"), ("c1", "c0")]}.get(checkpoints, [("c0", "c1")])
    verdict = {2: Verdict(), 4: Verdict(evidence="score"), 5: Verdict()}.get(seed, Verdict(True, seed == 3))
    said = [
        {
            "first": one,
            "second": other,
            "at": n if verdict.ended else None,
            "winner": one if verdict.apart else None,
        }
        for one, other in planned
    ]
    recipes = {"c0": "a recipe", "c1": "a recipe", "c2": "a recipe" if checkpoints == 3 else "another"}
    broken = [Interruption(9000, "c0", "s0", 1, 12.5)]
    limits = {} if seed == 2 else {f"s{scene}": 25.0 + 10 * scene for scene in range(1, scenes)}
    analysis = analyse(
        runs, broken, planned=dict.fromkeys(planned, verdict), limits=limits, whole=True, recipes=recipes
    )
    shown = json.loads(json.dumps(analysis.document))
    rows = [*as_rows(runs), Trial(9000, "x", 0, "c0", "s0", 1, "interrupted", False, 0.0, 12.5, "", ())]
    plan = {
        "stopping": {
            "alpha": 0.05,
            "rule": "evidence" if verdict.evidence else "none",
            "outcome": verdict.evidence or "success",
        },
        "comparisons": planned,
        "checkpoints": [{"name": name, "recipe": recipe} for name, recipe in recipes.items()],
        "scenes": [{"name": f"s{scene}", "time_limit_s": limits.get(f"s{scene}")} for scene in range(scenes)],
    }
    wrong = [
        (where, problem) for where, problem in differences(shown, numbers(rows, plan, said), "") if problem
    ]
    assert wrong == []


@pytest.mark.parametrize("seed", range(5))
def test_preferences_come_to_the_same(seed):
    chance, names = random.Random(seed), "abc"
    rows = []
    for _ in range(60):
        one, other = chance.sample(names, 2)
        rows.append(
            (one, other, chance.choice(("first", "first", "second", "tie")), chance.choice((1.0, 0.5)))
        )
    mine = judged.preferences(rows)
    lab = preferences([Comparison(*row) for row in rows], order_effect=True)
    assert {line["checkpoint"]: line["worth"] for line in mine["ranking"]} == pytest.approx(
        dict(lab.worth), abs=1e-6
    )
    assert {line["checkpoint"]: line["error"] for line in mine["ranking"]} == pytest.approx(
        dict(lab.error), abs=1e-6
    )
    assert (mine["tie"], mine["order"], mine["order_z"]) == pytest.approx(
        (lab.tie, lab.order, lab.order_z), abs=1e-6
    )
    same = [(name, name, "tie", 1.0) for name in names]  # two trials of one checkpoint, in random order
    assert judged.preferences(rows + same) == mine
    assert judged.preferences(same) is None


@pytest.mark.parametrize(
    "rows",
    [
        [("a", "b", "first", 1.0)] * 5,
        [("a", "b", "first", 1.0)] * 5 + [("a", "b", "tie", 1.0)] * 5,
        [("a", "b", "tie", 1.0)] * 3,
    ],
)
def test_what_cannot_be_ranked_is_ranked_by_neither(rows):
    assert judged.preferences(rows)["ranking"] is None
    with pytest.raises(NotIdentifiedError):
        preferences([Comparison(*row) for row in rows])


def test_agreement_comes_to_the_same():
    pairs = [(True, True)] * 20 + [(True, False)] * 5 + [(False, True)] * 10 + [(False, False)] * 15
    mine = judged.agreement(pairs)
    assert mine["kappa"] == pytest.approx(0.4)
    assert mine["kappa"] == pytest.approx(cohen_kappa(pairs))
    assert mine["ac1"] == pytest.approx(gwet_ac1(pairs))
    assert mine["alpha"] == pytest.approx(krippendorff_alpha([[float(a), float(b)] for a, b in pairs]))


def test_neither_takes_one_word_for_agreement():
    same = [(True, True)] * 9
    shown = agreement(same)
    assert (shown["kappa"], shown["ac1"], shown["alpha"]) == (None, 1.0, None)
    assert not any(problem for _, problem in differences(shown, judged.agreement(same), ""))
    against = [(True, False)] * 9
    assert not any(problem for _, problem in differences(agreement(against), judged.agreement(against), ""))
    assert (judged.score_alpha([(0.5, 0.5)] * 9), judged.score_alpha([(0.5, 0.5), (1.0, 1.0)])) == (None, 1.0)


def test_milestones_of_the_same_words_are_told_apart_by_both():
    said = [("held", 1), ("held (2)", 2), ("held", 3), ("on the plate", 4)]
    assert (
        by_text(said) == judged.by_text(said) == {"held": 1, "held (2)": 2, "held (3)": 3, "on the plate": 4}
    )


def test_letters_and_holm_come_to_the_same():
    apart = {frozenset(pair) for pair in ("AC", "AD", "BD")}
    assert (
        methods.letters("ABCD", apart) == letters("ABCD", apart) == {"A": "a", "B": "ab", "C": "bc", "D": "c"}
    )
    assert methods.holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx(holm([0.01, 0.04, 0.03, 0.005]))


@pytest.mark.parametrize(
    "differences",
    [[], [-1.0], [0.0] * 40, [1.0] * 30 + [-1.0] * 60, [1.0] * 9, [-1.0] * 250, [0.25, -0.5, 1.0] * 30],
)
def test_what_a_difference_can_be_at_any_time_comes_to_the_same(differences):
    found = confidence_sequence(differences, 0.05)
    mine = methods.anytime(differences, 0.05)
    assert mine == (found and pytest.approx([found.low, found.high], rel=1e-9, abs=1e-10))


def test_a_bet_on_scores_comes_to_the_same_after_its_luck_has_turned():
    differences = [1.0] * 125 + [-1.0] * 125
    lab = score_evidence([(max(d, 0.0), max(-d, 0.0)) for d in differences])
    assert methods.score_bets(differences) == pytest.approx(lab.first)


def test_published_values():
    assert methods.wilson(81, 263) == pytest.approx([0.2553, 0.3662], abs=5e-5)
    assert methods.clopper_pearson(15, 148) == pytest.approx([0.0578, 0.1617], abs=5e-5)
    assert methods.newcombe(56, 70, 48, 80) == pytest.approx([0.0524, 0.3339], abs=5e-5)
    assert methods.barnard(43, 53, 40, 79) == pytest.approx((3.555406780, 0.000362832), abs=1e-8)
    assert methods.mcnemar(8, 2) == 0.109375
