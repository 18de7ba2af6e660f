import subprocess
import sys

import numpy as np
import pytest

from evaweb.results.analysis.analysis import analyse
from evaweb.results.analysis.comparison import Standing, Verdict
from evaweb.results.analysis.outcomes import Outcome, pair_by_block
from evaweb.statistics.proportions import clopper_pearson

LABELS = ("held", "lifted", "on the plate")
DECIDED = Verdict(True, True)


def trials(rates, blocks=40, scenes=("cups",), seed=3):
    """Blocks of all checkpoints, one after the other, as a plan hands them out."""
    random = np.random.default_rng(seed)
    found = []
    for block in range(blocks):
        for name, rate in rates.items():
            success = bool(random.random() < rate)
            lifted = success or bool(random.random() < 0.5)
            found.append(
                Outcome(
                    trial=len(found) + 1,
                    order=len(found),
                    block=str(block),
                    checkpoint=name,
                    scene=scenes[block % len(scenes)],
                    position=block % 5,
                    success=success,
                    score=1.0 if success else 0.5 * lifted,
                    duration=float(random.uniform(5, 30)),
                    milestones=(True, lifted, success),
                    failure="" if success else ("dropped" if lifted else ""),
                    failure_phase="" if success or block % 2 else "grasp",
                    labels=LABELS,
                )
            )
    return found


def test_the_better_one_comes_first_with_everything_that_is_said_of_it():
    found = analyse(trials({"old": 0.4, "new": 0.9}))
    assert [arm.checkpoint for arm in found.arms] == ["new", "old"]
    new = found.arm("new")
    assert new.success.n == 40
    assert new.exact.low < new.success.interval.low
    assert sum(cell.n for cell in new.cells.values()) == 40
    assert [step.of_all.n for step in new.funnels[0].steps] == [40, 40, 40]
    assert new.funnels[0].labels == LABELS
    assert new.curve.successes == new.success.successes == new.speed.events
    old = found.arm("old")
    assert sum(mode.count for mode in old.failures) == old.success.n - old.success.successes
    assert {mode.words for mode in old.failures} == {"grasp: dropped", "dropped", "grasp", "not specified"}
    assert [mode.count for mode in old.failures] == sorted((m.count for m in old.failures), reverse=True)
    assert all(mode.interval == clopper_pearson(mode.count, 40) for mode in old.failures)
    assert found.letters == {"new": "a", "old": "b"}
    assert found.notes == ()


def test_a_comparison_has_all_its_evidence():
    found = analyse(trials({"old": 0.4, "new": 0.9}), planned={("old", "new"): DECIDED})
    compared = found.comparison_of("new", "old")
    assert (compared.first, compared.second) == ("old", "new")
    assert compared.difference.value < 0
    assert compared.difference.interval.high < 0
    assert compared.test.p == compared.corrected < 0.001
    assert compared.better < 0.001
    assert compared.pairs == compared.paired.pairs == 40
    assert compared.clustered.value == pytest.approx(compared.difference.value)
    assert (
        compared.clustered.interval.low < compared.difference.interval.low
    )  # of five positions, not of 40 trials
    assert compared.stratified is None
    assert compared.evidence.winner == compared.score_evidence.winner == "second"
    assert compared.anytime.low < compared.difference.value < compared.anytime.high < 0
    assert compared.score_anytime.high < 0


@pytest.mark.parametrize("evidence", ["", "success", "score"])
def test_a_planned_comparison_whose_design_has_not_ended_is_described_and_nothing_of_it_decides(evidence):
    found = analyse(
        trials({"old": 0.4, "new": 0.9, "other": 0.1}), planned={("old", "new"): Verdict(evidence=evidence)}
    )
    of_it = found.comparison_of("old", "new")
    assert of_it.standing is Standing.OPEN
    assert of_it.difference.interval.high < 0
    for name in ("test", "corrected", "better", "paired", "scored", "anytime", "score_anytime", "time_test"):
        assert getattr(of_it, name) is None, name
    assert (of_it.evidence is None, of_it.score_evidence is None) == (
        evidence != "success",
        evidence != "score",
    )
    assert found.letters == {}
    beside = found.comparison_of("other", "new")
    assert (beside.standing, beside.corrected < 0.001) == (Standing.UNPLANNED, True)


def test_runs_of_a_recipe_are_summed_up_by_runs_and_of_three_with_an_interval():
    rates = {"a1": 0.9, "a2": 0.7, "a3": 0.8, "b1": 0.4, "b2": 0.5, "c1": 0.2}
    recipes = {name: name[0] for name in rates} | {"c1": ""}
    found = {one.name: one for one in analyse(trials(rates), recipes=recipes).recipes}
    assert list(found) == ["a", "b"]
    assert found["a"].mean.value == pytest.approx(sum(found["a"].rates.values()) / 3)
    assert (found["a"].mean.n, found["a"].mean.interval.low < found["a"].mean.value) == (3, True)
    assert (found["b"].mean.n, found["b"].mean.interval) == (2, None)


def test_letters_tell_apart_what_the_design_did_and_nothing_else():
    outcomes = trials({"old": 0.4, "new": 0.9})
    for verdict, letters in (
        (Verdict(True, False), {"new": "a", "old": "a"}),
        (Verdict(True, True), {"new": "a", "old": "b"}),
        (Verdict(True, None), {}),
    ):
        assert analyse(outcomes, planned={("old", "new"): verdict}).letters == letters


def timed(name, rows):
    """Trials of one checkpoint, a block each, from (succeeded, seconds)."""
    return [
        Outcome(i, i, str(i), name, "cups", 1, ok, float(ok), seconds) for i, (ok, seconds) in enumerate(rows)
    ]


def test_nine_of_ten_are_sooner_than_five_of_ten_that_gave_up_early():
    """Failures of B ended after 2 s: taken for successes to come, B would be the sooner one with p = 0.0002."""
    first = timed("A", [(True, 20.0)] * 9 + [(False, 40.0)])
    second = timed("B", [(True, 10.0)] * 5 + [(False, 2.0)] * 5)
    found = analyse(first + second, planned={("A", "B"): DECIDED}, limits={"cups": 40.0, "plates": 60.0})
    assert found.arm("A").mean_time.value == pytest.approx(22.0)
    assert found.arm("B").mean_time.value == pytest.approx(25.0)
    sooner = found.comparisons[0].time_test
    assert (sooner.pairs, sooner.value) == (10, pytest.approx(-3.0))
    assert sooner.p > 0.05


def test_one_horizon_for_all_is_the_smallest_limit_or_the_longest_run():
    runs = timed("A", [(True, 20.0), (True, 40.02)]) + timed("B", [(True, 10.0), (False, 55.0)])
    curves = {arm.checkpoint: arm.curve for arm in analyse(runs).arms}
    assert {curve.until for curve in curves.values()} == {55.0}
    limited = analyse(runs, limits={"cups": 40.0})
    assert {arm.mean_time.until for arm in limited.arms} == {40.0}
    assert limited.arm("A").curve.successes == 2  # it ran to its limit, and the station a moment longer
    other = analyse(runs, limits={"cups": 60.0, "plates": 30.0})
    assert other.arm("A").curve.successes == 1


def test_a_time_that_is_not_known_has_no_part_in_who_is_sooner():
    runs = timed("A", [(True, None), (True, 5.0)]) + timed("B", [(True, 9.0), (True, 9.0)])
    found = analyse(runs, planned={("A", "B"): DECIDED})
    assert (found.comparisons[0].time_test.pairs, found.comparisons[0].time_test.value) == (1, -4.0)
    assert analyse(timed("A", [(True, None)]) + timed("B", [(True, None)])).comparisons[0].time_test is None


def test_three_checkpoints_are_corrected_for_three_comparisons():
    found = analyse(trials({"a": 0.9, "b": 0.85, "c": 0.2}))
    assert len(found.comparisons) == 3
    smallest = min(found.comparisons, key=lambda c: c.test.p)
    assert smallest.corrected == pytest.approx(3 * smallest.test.p)
    assert found.letters["a"] == found.letters["b"] == "a"
    assert found.letters["c"] == "b"
    assert {c.evidence.alpha for c in found.comparisons} == {0.05 / 3}
    assert {c.anytime.level for c in found.comparisons} == {1 - 0.05 / 3}
    planned = analyse(trials({"a": 0.9, "b": 0.85, "c": 0.2}), planned={("a", "c"): DECIDED})
    shares = {(c.first, c.second): c.evidence.alpha for c in planned.comparisons}
    assert shares == {("a", "b"): 0.05 / 3, ("a", "c"): 0.05, ("b", "c"): 0.05 / 3}


def test_the_same_outcomes_say_the_same():
    one, other = analyse(trials({"a": 0.5, "b": 0.6})), analyse(trials({"a": 0.5, "b": 0.6})[::-1])
    assert one == other


def test_several_scenes_are_stratified_and_a_reversal_is_seen():
    easy = [
        (f"e{i}", name, "easy", ok)
        for name, n, x in (("a", 87, 81), ("b", 270, 234))
        for i, ok in enumerate([True] * x + [False] * (n - x))
    ]
    hard = [
        (f"h{i}", name, "hard", ok)
        for name, n, x in (("a", 263, 192), ("b", 80, 55))
        for i, ok in enumerate([True] * x + [False] * (n - x))
    ]
    outcomes = [
        Outcome(i, i, block, name, scene, 1, ok, float(ok))
        for i, (block, name, scene, ok) in enumerate(easy + hard)
    ]
    found = analyse(outcomes)
    compared = found.comparison_of("a", "b")
    assert compared.stratified.reversed
    assert "2 of 2 initial conditions were not tried equally often" in found.notes[0]
    assert found.arm("a").macro.value > found.arm("b").macro.value


def test_a_block_that_is_not_complete_waits():
    outcomes = trials({"old": 0.5, "new": 0.5}, blocks=10)[:-1]
    compared = analyse(outcomes).comparisons[0]
    assert (compared.pairs, compared.evidence.pairs) == (9, 9)
    assert any("1 trial has no partner" in note for note in compared.notes)


def test_evidence_of_a_whole_plan_ends_before_the_first_block_that_lacks_a_trial():
    """As its design does: what is made after it could else be chosen by what it says."""
    outcomes = trials({"old": 0.5, "new": 0.5}, blocks=12)
    waits = [one for one in outcomes if (one.block, one.checkpoint) != ("4", "old")]
    compared = analyse(waits, whole=True).comparisons[0]
    assert (compared.pairs, compared.evidence.pairs, compared.score_evidence.pairs) == (11, 4, 4)
    assert any("7 pairs come after a block that lacks a trial" in note for note in compared.notes)
    unmade = [one for one in outcomes if one.block != "4"]
    assert analyse(unmade, whole=True).comparisons[0].evidence.pairs == 4
    assert analyse(outcomes, whole=True).comparisons[0].evidence.pairs == 12


def test_pairs_are_in_the_order_in_which_they_were_completed():
    def one(checkpoint, block, order):
        return Outcome(order, order, block, checkpoint, "cups", 1, True, 1.0)

    first = [one("a", "x", 0), one("a", "y", 1)]
    second = [one("b", "y", 2), one("b", "x", 3)]
    assert [pair.first.block for pair in pair_by_block(first, second)] == ["y", "x"]


def test_pairs_of_a_plan_are_in_the_order_of_its_blocks_whichever_station_was_faster():
    def one(checkpoint, block, order):
        return Outcome(order, order, str(block), checkpoint, "cups", 1, True, 1.0)

    first = [one("a", 9, 1), one("a", 10, 0)]
    second = [one("b", 10, 2), one("b", 9, 3)]
    assert [pair.first.block for pair in pair_by_block(first, second)] == ["9", "10"]


def test_what_cannot_be_computed_says_why():
    outcomes = [Outcome(1, 0, "x", "a", "cups", 1, True, 1.0), Outcome(2, 1, "x", "b", "cups", 1, False, 0.0)]
    found = analyse(outcomes)
    compared = found.comparisons[0]
    assert compared.clustered is None
    assert any("at least 2 are needed" in note for note in compared.notes)
    assert found.arm("a").curve is None
    assert found.arm("a").funnels == ()


def test_one_checkpoint_is_described_and_nothing_compared():
    found = analyse(trials({"only": 0.5}))
    assert found.comparisons == ()
    assert found.letters == {"only": "a"}
    assert analyse([]).arms == ()


def test_it_is_computed_without_django():
    program = "import sys, evaweb.results.analysis.analysis; print('django' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
