"""Judges are found by name, and one that fails is told in one sentence that names it."""

import sys
from types import ModuleType

import pytest

from evaweb.core.errors import EvaError
from evaweb.results import judges
from evaweb.results.judges.base import (
    CaseJudgement,
    MilestoneJudgement,
    MilestonePrompt,
    NoVerdict,
    Setup,
    TrialCase,
)
from evaweb.results.judges.loading import build_judge

CASE = TrialCase("put it there", "", (MilestonePrompt("held"), MilestonePrompt("there")), truth=(True, None))


@pytest.fixture
def plug_in(monkeypatch):
    """A judge of somebody's, of the kind `odd`, whose `judge` does that."""

    def make(judge):
        module = ModuleType("odd_judge")
        one = type("Odd", (), {"version": "odd 1", "words": lambda self, case: "", "judge": judge})
        module.SEES, module.SERVED, module.build = "pictures", False, lambda setup: one()
        monkeypatch.setitem(sys.modules, "odd_judge", module)
        monkeypatch.setitem(judges.KINDS, "odd", "odd_judge")
        return build_judge("mine", "odd", Setup())

    return make


def test_the_two_that_come_with_the_product_are_found_by_name():
    bench, chat = (
        build_judge("b", "bench", Setup()),
        build_judge("c", "chat", Setup("https://judge.example", "seer")),
    )
    assert [(one.pictures, one.served, one.version) for one in (bench, chat)] == [
        (False, False, "bench 1"),
        (True, True, "chat 1, seer"),
    ]
    with pytest.raises(EvaError, match="judge x: kind = 'none'; allowed: bench, chat"):
        build_judge("x", "none", Setup())


def test_the_bench_is_certain_of_what_it_reports_and_silent_about_the_rest():
    bench = build_judge("b", "bench", Setup())
    assert bench.judge_case(CASE).milestones == (MilestoneJudgement(True, 1.0), MilestoneJudgement())
    with pytest.raises(NoVerdict, match="reports none"):
        bench.judge_case(TrialCase("", "", (MilestonePrompt("held"),), truth=(None,)))


def test_a_judge_of_somebodys_own_joins_by_its_name(plug_in):
    verdict = CaseJudgement((MilestoneJudgement(True, 0.5), MilestoneJudgement(False, 0.5)))
    assert plug_in(lambda self, case: verdict).judge_case(CASE) == verdict


def test_one_that_fails_is_named(plug_in):
    def fails(self, case):
        raise KeyError("weights")

    with pytest.raises(EvaError, match=r"^judge mine: KeyError: 'weights'$"):
        plug_in(fails).judge_case(CASE)
    with pytest.raises(EvaError, match=r"^judge mine: 1 verdicts on 2 milestones$"):
        plug_in(lambda self, case: CaseJudgement((MilestoneJudgement(),))).judge_case(CASE)


def test_one_that_cannot_be_loaded_is_named_with_its_file(monkeypatch):
    monkeypatch.setitem(judges.KINDS, "gone", "evaweb.results.judges.gone")
    with pytest.raises(
        EvaError, match=r"judge mine: .*kind 'gone' cannot be loaded: .*gone\.py: ModuleNotFound"
    ):
        build_judge("mine", "gone", Setup())


@pytest.mark.parametrize(
    "said", [(True, None), (None, 0.5), (True, 1.1), (False, float("nan")), (True, 0.4), (False, 0.6)]
)
def test_a_word_that_cannot_be_is_none(said):
    with pytest.raises(ValueError, match=r"probability|contradicts"):
        MilestoneJudgement(*said)
