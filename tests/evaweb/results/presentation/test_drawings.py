from dataclasses import replace
from xml.etree import ElementTree

import pytest
from django.template import Context, Template

from evaweb.results.analysis.analysis import analyse
from evaweb.results.presentation.drawings import conditions, courses, rates
from evaweb.results.presentation.drawings.svg import ticks, wrapped
from tests.evaweb.results.reports.test_recompute import outcomes

NASTY = "<script>alert('x')</script> & \"more\""


@pytest.fixture(scope="module")
def analysis():
    runs = outcomes(3, 60, 2, 7)
    return analyse(
        [
            type(r)(**{**{f: getattr(r, f) for f in r.__slots__}, "failure": NASTY if r.failure else ""})
            for r in runs
        ]
    )


def figures(analysis):
    order = {arm.checkpoint: i for i, arm in enumerate(analysis.arms)}
    found = analysis.comparisons[0]
    return {
        "intervals": rates.intervals(
            "Rates", [(a.checkpoint, a.success, "/x?a=1&b=2") for a in analysis.arms], order
        ),
        "violins": rates.violins(analysis.arms, analysis.letters),
        "difference": rates.difference(found),
        "funnel": courses.funnel(
            "s0", [(i, a.checkpoint, a.funnels[0]) for i, a in enumerate(analysis.arms)], {}
        ),
        "success_times": courses.success_times(analysis.arms),
        "evidence": courses.evidence(found.evidence, found.first, found.second, 40),
        "grid": conditions.grid(analysis.arms, {}),
        "pareto": conditions.pareto(0, analysis.arms[0], {("", NASTY): "/trials/?failure=1&x=2"}),
    }


def test_every_figure_is_svg_with_a_title_and_the_same_in_words(analysis):
    for name, drawn in figures(analysis).items():
        root = ElementTree.fromstring(drawn)
        title, words = root[0], root[1]
        assert root.get("role") == "img", name
        assert root.get("aria-labelledby") == f"{title.get('id')} {words.get('id')}", name
        assert (title.text, words.text) == (drawn.heading, drawn.words), name
        assert len(words.text) > 10, name


def test_no_text_is_markup(analysis):
    drawn = figures(analysis)["pareto"]
    assert "<script" not in drawn
    assert Template("{{ drawn }}").render(Context({"drawn": drawn})) == drawn


def test_a_rate_stands_with_n_and_interval_in_words(analysis):
    first = analysis.arms[0]
    assert f"{first.success.successes}/{first.success.n}, " in figures(analysis)["intervals"].words
    assert "[" in figures(analysis)["intervals"].words


def test_series_are_told_apart_by_more_than_colour(analysis):
    marks = [
        e.get("d")
        for e in ElementTree.fromstring(figures(analysis)["violins"]).iter()
        if "mark" in (e.get("class") or "")
    ]
    shapes = {"".join(c for c in d if c.isalpha()) + str(d.count("L")) for d in marks}
    assert len(marks) == 3
    assert len(shapes) == 3


@pytest.mark.parametrize(("low", "high"), [(0, 1), (0, 57.3), (-2, 2.6), (0, 1000)])
def test_ticks_are_round_and_within(low, high):
    found = ticks(low, high)
    assert 3 <= len(found) <= 9
    assert all(low <= tick <= high for tick in found)


LONG = ("pi0-fold-2026-11-03-lr3e-5-ema", "pi0-fold-2026-11-18-lr1e-5")


@pytest.mark.parametrize(
    "name", [*LONG, "act", "", "x" * 90, "a b", "grasped and lifted and carried and " * 4]
)
@pytest.mark.parametrize("rows", [1, 2, 3])
def test_a_label_is_in_as_few_lines_as_it_needs_and_keeps_its_end(name, rows):
    found = wrapped(name, 22, rows)
    assert 1 <= len(found) <= rows
    assert max(map(len, found)) <= 22
    said = "".join(found)
    assert said.replace(" ", "") == name.replace(" ", "") or ("…" in said and said[-8:] == name[-8:])


def test_checkpoints_whose_names_begin_alike_are_told_apart_in_every_figure(analysis):
    arms = [replace(arm, checkpoint=name) for arm, name in zip(analysis.arms, LONG, strict=False)]
    letters = dict.fromkeys(LONG, "a")
    one = analysis.comparisons[0].evidence
    drawn = {
        "intervals": rates.intervals("Rates", [(a.checkpoint, a.success, "") for a in arms], {}),
        "violins": rates.violins(arms, letters),
        "funnel": courses.funnel("s0", [(i, a.checkpoint, a.funnels[0]) for i, a in enumerate(arms)], {}),
        "success_times": courses.success_times(arms),
        "evidence": courses.evidence(one, *LONG),
        "grid": conditions.grid(arms, {}),
    }
    for figure, markup in drawn.items():
        texts = [e.text or "" for e in ElementTree.fromstring(markup).iter() if e.tag.endswith("text")]
        for end in ("lr3e-5-ema", "lr1e-5"):
            assert any(end in text.replace("-better", "") for text in texts), (figure, end)
