"""Judges are found by name, and one that fails is told in one sentence that names it."""

import sys
from types import ModuleType

import pytest

from evaweb.errors import EvaError
from evaweb.results import judges
from evaweb.results.judges.base import Case, NoVerdict, Said, Setup, Step, Verdict
from evaweb.results.judges.finding import built

CASE = Case("put it there", "", (Step("held"), Step("there")), truth=(True, None))


@pytest.fixture
def plug_in(monkeypatch):
    """A judge of somebody's, of the kind `odd`, whose `judge` does that."""

    def make(judge):
        module = ModuleType("odd_judge")
        one = type("Odd", (), {"version": "odd 1", "words": lambda self, case: "", "judge": judge})
        module.SEES, module.SERVED, module.build = "pictures", False, lambda setup: one()
        monkeypatch.setitem(sys.modules, "odd_judge", module)
        monkeypatch.setitem(judges.KINDS, "odd", "odd_judge")
        return built("mine", "odd", Setup())

    return make


def test_the_two_that_come_with_the_product_are_found_by_name():
    bench, chat = built("b", "bench", Setup()), built("c", "chat", Setup("https://judge.example", "seer"))
    assert [(one.pictures, one.served, one.version) for one in (bench, chat)] == [
        (False, False, "bench 1"),
        (True, True, "chat 1, seer"),
    ]
    with pytest.raises(EvaError, match="judge x: kind = 'none'; allowed: bench, chat"):
        built("x", "none", Setup())


def test_the_bench_is_certain_of_what_it_reports_and_silent_about_the_rest():
    bench = built("b", "bench", Setup())
    assert bench.asked(CASE).milestones == (Said(True, 1.0), Said())
    with pytest.raises(NoVerdict, match="reports none"):
        bench.asked(Case("", "", (Step("held"),), truth=(None,)))


def test_a_judge_of_somebodys_own_joins_by_its_name(plug_in):
    verdict = Verdict((Said(True, 0.5), Said(False, 0.5)))
    assert plug_in(lambda self, case: verdict).asked(CASE) == verdict


def test_one_that_fails_is_named(plug_in):
    def fails(self, case):
        raise KeyError("weights")

    with pytest.raises(EvaError, match=r"^judge mine: KeyError: 'weights'$"):
        plug_in(fails).asked(CASE)
    with pytest.raises(EvaError, match=r"^judge mine: 1 verdicts on 2 milestones$"):
        plug_in(lambda self, case: Verdict((Said(),))).asked(CASE)


def test_one_that_cannot_be_loaded_is_named_with_its_file(monkeypatch):
    monkeypatch.setitem(judges.KINDS, "gone", "evaweb.results.judges.gone")
    with pytest.raises(
        EvaError, match=r"judge mine: .*kind 'gone' cannot be loaded: .*gone\.py: ModuleNotFound"
    ):
        built("mine", "gone", Setup())


@pytest.mark.parametrize(
    "said", [(True, None), (None, 0.5), (True, 1.1), (False, float("nan")), (True, 0.4), (False, 0.6)]
)
def test_a_word_that_cannot_be_is_none(said):
    with pytest.raises(ValueError, match=r"probability|contradicts"):
        Said(*said)
