import csv
import io
import math
import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pytest
from django.template import Context, Template

from evaweb.results.analysis.analysis import analyse
from evaweb.results.presentation.drawings import conditions, rates, time_courses
from evaweb.results.presentation.drawings.svg import SERIES, printable, ticks, wrapped
from evaweb.statistics.proportions import proportion
from tests.evaweb.results.reports.test_recompute import outcomes

STATIC = Path(__file__).parents[4] / "static"
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
        "intervals": rates.draw_intervals(
            "Rates", [(a.checkpoint, a.success, "/x?a=1&b=2") for a in analysis.arms], order
        ),
        "violins": rates.draw_violins(analysis.arms, analysis.letters),
        "difference": rates.draw_difference(found),
        "funnel": time_courses.draw_funnel(
            "s0", [(i, a.checkpoint, a.funnels[0]) for i, a in enumerate(analysis.arms)], {}
        ),
        "success_times": time_courses.draw_success_times(analysis.arms),
        "evidence": time_courses.draw_evidence(found.evidence, found.first, found.second, 40),
        "grid": conditions.draw_grid(analysis.arms, {}),
        "pareto": conditions.draw_pareto(analysis.arms[0], {("", NASTY): "/trials/?failure=1&x=2"}),
    }


def test_every_figure_is_svg_with_a_title_and_the_same_in_words(analysis):
    for name, drawn in figures(analysis).items():
        root = ElementTree.fromstring(drawn)
        title, words = root[0], root[1]
        assert root.get("role") == ("group" if "<a " in drawn else "img"), name
        assert root.get("aria-labelledby") == f"{title.get('id')} {words.get('id')}", name
        assert (title.text, words.text) == (drawn.heading, drawn.words), name
        assert len(words.text) > 10, name


def rows_of(drawn):
    """The figure's data."""
    metadata = ElementTree.fromstring(drawn).find("metadata")
    return list(csv.DictReader(io.StringIO(metadata.text)))


def test_every_figure_carries_the_numbers_that_it_was_drawn_from(analysis):
    data = {name: rows_of(drawn) for name, drawn in figures(analysis).items()}
    best, found = analysis.arms[0], analysis.comparisons[0]
    steps = best.funnels[0].steps
    assert {name: len(rows) for name, rows in data.items()} == {
        "intervals": 3,
        "violins": 3,
        "difference": 1,
        "funnel": 3 * len(steps),
        "success_times": sum(len(arm.curve.times) for arm in analysis.arms),
        "evidence": 2 * found.evidence.pairs,
        "grid": sum(len(arm.cells) for arm in analysis.arms),
        "pareto": len(best.failures),
    }
    first = data["intervals"][0]
    assert (first["checkpoint"], int(first["trials"])) == (best.checkpoint, best.success.n)
    assert float(first["low"]) == best.success.interval.low
    assert float(data["difference"][0]["difference"]) == found.difference.value
    assert float(data["evidence"][-1]["e_value_log10"]) == pytest.approx(
        found.evidence.second[-1] / math.log(10)
    )
    assert data["pareto"][0]["cause"] == NASTY


def test_legend_and_bars_are_in_the_order_of_series_whoever_is_best(analysis):
    found = [(arm.series, arm.checkpoint, arm.funnels[0]) for arm in analysis.arms]
    named = [row["checkpoint"] for row in rows_of(time_courses.draw_funnel("s0", found[::-1], {}))]
    assert list(dict.fromkeys(named)) == [name for _, name, _ in sorted(found)]


def test_what_is_of_no_checkpoint_has_no_checkpoints_colour(analysis):
    drawn = figures(analysis)
    assert not re.search(r"series-\d", drawn["difference"] + drawn["grid"])
    assert "series-none" in drawn["difference"]


def contrast(one, other):
    """Of two colours as WCAG 2 has it."""

    def luminance(colour):
        shares = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
        lit = [share / 12.92 if share <= 0.04045 else ((share + 0.055) / 1.055) ** 2.4 for share in shares]
        return 0.2126 * lit[0] + 0.7152 * lit[1] + 0.0722 * lit[2]

    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


def colours(theme):
    """What tokens.css says of a theme, and the colours that figures stand on."""
    tokens = (STATIC / "css" / "tokens.css").read_text()
    block = re.search(rf'html\[data-theme="{theme}"\][^{{]*{{(.*?)}}', tokens, re.DOTALL)[1]
    return block, [re.search(rf"--{name}: (#\w{{6}})", block)[1] for name in ("ground", "panel")]


@pytest.mark.parametrize(("theme", "at"), [("light", 0), ("dark", 1)])
def test_every_series_stands_out_from_what_it_is_drawn_on_in_both_themes(theme, at):
    _, grounds = colours(theme)
    found = re.findall(
        r"--series: light-dark\((#\w{6}), (#\w{6})\)", (STATIC / "result" / "figures.css").read_text()
    )
    assert len(found) == SERIES
    assert len({pair[at] for pair in found}) == SERIES
    for pair in found:
        assert min(contrast(pair[at], ground) for ground in grounds) >= 3, pair[at]


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_the_hairlines_of_chunks_and_their_swatch_in_the_legend_stand_out(theme):
    block, grounds = colours(theme)
    parts = re.search(r"--mark-chunk: rgb\((\d+) (\d+) (\d+) / (\d+)%\)", block).groups()
    share = int(parts[3]) / 100
    for ground in grounds:
        below = [int(ground[i : i + 2], 16) for i in (1, 3, 5)]
        drawn = [
            round(share * int(part) + (1 - share) * under)
            for part, under in zip(parts[:3], below, strict=True)
        ]
        assert contrast("#" + "".join(f"{part:02x}" for part in drawn), ground) >= 3


def test_no_text_is_markup(analysis):
    drawn = figures(analysis)["pareto"]
    assert "<script" not in drawn
    assert Template("{{ drawn }}").render(Context({"drawn": drawn})) == drawn


def test_a_name_of_before_with_characters_that_xml_has_not_is_drawn_without_them():
    name = "a\x01\x0b\ud800\ufffe\uffffb\u202e"
    drawn = rates.draw_intervals("Rates \x02", [(name, proportion(3, 4), "")], {name: 0})
    for svg in (drawn, printable(drawn, [name], [name])):
        root = ElementTree.fromstring(svg.encode())
        assert "a\ufffd\ufffd\ufffd\ufffd\ufffdb\u202e" in [each.text for each in root.iter()]


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
        "intervals": rates.draw_intervals("Rates", [(a.checkpoint, a.success, "") for a in arms], {}),
        "violins": rates.draw_violins(arms, letters),
        "funnel": time_courses.draw_funnel(
            "s0", [(i, a.checkpoint, a.funnels[0]) for i, a in enumerate(arms)], {}
        ),
        "success_times": time_courses.draw_success_times(arms),
        "evidence": time_courses.draw_evidence(one, *LONG),
        "grid": conditions.draw_grid(arms, {}),
    }
    for figure, markup in drawn.items():
        texts = [e.text or "" for e in ElementTree.fromstring(markup).iter() if e.tag.endswith("text")]
        for end in ("lr3e-5-ema", "lr1e-5"):
            assert any(end in text.replace("-better", "") for text in texts), (figure, end)


def test_a_checkpoint_has_one_colour_whichever_of_them_are_chosen_and_whichever_is_ahead():
    runs = outcomes(3, 60, 2, 7)
    named = sorted({run.checkpoint for run in runs})
    whole = {arm.checkpoint: arm.series for arm in analyse(runs, checkpoints=named).arms}
    assert whole == {name: at for at, name in enumerate(named)}
    for left in named:
        some = analyse([run for run in runs if run.checkpoint != left], checkpoints=named)
        assert {arm.checkpoint: arm.series for arm in some.arms} == {
            n: s for n, s in whole.items() if n != left
        }
        (found,) = some.comparisons
        places = (whole[found.first], whole[found.second])
        drawn = time_courses.draw_evidence(found.evidence, found.first, found.second, drawn=places)
        assert set(re.findall(r"series-[0-9]+", drawn)) == {f"series-{at + 1}" for at in places}
