"""Plots over time: milestones as a funnel, time to success as a curve, evidence and power by pairs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from evaweb.results.analysis.arm import Arm, Funnel
from evaweb.results.analysis.wording import evidence_text, rate_words
from evaweb.results.presentation.drawings.svg import (
    LINE,
    PROPORTION,
    Drawing,
    Scale,
    counted,
    drawing,
    element,
    label,
    legend,
    line,
    link,
    mark,
    number,
    percent_axis,
    series,
    ticks,
    words,
    wrapped,
)
from evaweb.statistics.proportions import wilson
from evaweb.statistics.sequential import Evidence

WIDTH = 600
_LABELS = 180
_LETTERS = 22  # characters per line of a milestone or name
_LEGEND = 190  # space to the right of a curve


def draw_funnel(
    scene: str, found: Sequence[tuple[int, str, Funnel]], links: Mapping[tuple[str, int], str]
) -> Drawing:
    """Draw for each milestone one bar per checkpoint with its interval; `found` has (series, name, funnel) per
    checkpoint.

    `links` maps (checkpoint, index of the milestone) to the address of a list of the trials that did not reach it.
    """
    found = sorted(found, key=lambda one: one[0])  # the order of every other legend
    steps = len(found[0][2].steps) if found else 0
    bar, gap = 16, 16
    whose, y = legend([(i, name) for i, name, _ in found], WIDTH)
    height = y + steps * (bar * len(found) + gap) + 30
    scale = Scale(0, 1, _LABELS, WIDTH - 160)
    parts = [whose, percent_axis(scale, height - 26, y)]
    for at in range(steps):
        milestone = found[0][2].labels[at]
        middle = y + bar * len(found) / 2
        parts.append(
            label(
                _LABELS - 12, middle + 3, f"{at + 1} {milestone}", _LETTERS, "end", 2 if len(found) < 3 else 3
            )
        )
        for i, name, rows in found:
            of_all, before = rows.steps[at].of_all, rows.steps[at].of_previous
            title = f"{name}, {milestone}: {rate_words(of_all)}; of those before: {rate_words(before)}"
            row = ""
            if of_all.rate is not None and of_all.interval is not None:
                half = y + bar / 2 - 1
                row += element(
                    "rect", x=scale(0), y=y, width=scale(of_all.rate) - scale(0), height=float(bar - 3),
                    class_=f"beam {series(i)}",
                )  # fmt: skip
                row += line(
                    [(scale(of_all.interval.low), half), (scale(of_all.interval.high), half)], "error"
                )
            row += words(WIDTH - 150, y + bar - 4, rate_words(of_all), class_="value small")
            parts.append(link(links.get((name, at), ""), title, row))
            y += bar
        y += gap
    description = "; ".join(
        f"{name}: "
        + ", ".join(f"{t} {rate_words(s.of_all)}" for t, s in zip(rows.labels, rows.steps, strict=True))
        for _, name, rows in found
    )
    return drawing(
        WIDTH, height, f"Milestones of {scene}, share of all trials", description, *parts, kind="funnel",
        columns=("checkpoint", "order", "milestone", *PROPORTION),
        rows=[
            (name, at, text, *counted(step.of_all))
            for _, name, rows in found
            for at, (text, step) in enumerate(zip(rows.labels, rows.steps, strict=True), 1)
        ],
    )  # fmt: skip


def draw_success_times(arms: Sequence[Arm]) -> Drawing | None:
    """Draw the share of successes over time up to the horizon, with pointwise bands."""
    drawn = [(arm.series, arm, arm.curve) for arm in arms if arm.curve is not None]
    if not drawn:
        return None
    end = drawn[0][2].until
    height, bottom = 300, 250
    x, y = Scale(0, end, 50, WIDTH - _LEGEND), Scale(0, 1, bottom, 14)
    parts = []
    for share in range(0, 101, 25):
        parts.append(line([(x(0), y(share / 100)), (x(end), y(share / 100))], "grid"))
        parts.append(words(42, y(share / 100) + 5, f"{share}", "end", "tick"))
    parts += [words(x(t), bottom + 18, number(t), "middle", "tick") for t in ticks(0, end, 6)]
    parts.append(words(x(end / 2), bottom + 38, "time [s]", "middle", "tick"))
    texts = []
    labels: list[tuple[float, int, str]] = []
    for i, arm, curve in drawn:
        # Before the first success the band is that of 0 of n.
        bands = wilson(0, curve.n)
        low, high = (
            _steps(curve.times, side, start, end)
            for side, start in ((curve.low, bands.low), (curve.high, bands.high))
        )
        parts.append(
            element("path", d=_area([(x(a), y(b)) for a, b in high], [(x(a), y(b)) for a, b in low]),
                    class_=f"shade {series(i)}")
        )  # fmt: skip
        parts.append(
            line([(x(a), y(b)) for a, b in _steps(curve.times, curve.share, 0, end)], f"curve {series(i)}")
        )
        labels.append((y(curve.successes / curve.n), i, arm.checkpoint))
        median = f"half within {curve.median:.1f} s" if curve.median is not None else "half never"
        texts.append(f"{arm.checkpoint}: {median}, {curve.successes} of {curve.n} within {end:.1f} s")
    parts += _names(labels, x(end), bottom)
    return drawing(
        WIDTH, height, "Time to success: percentage of trials that have succeeded", "; ".join(texts), *parts,
        kind="success-times",
        columns=("checkpoint", "time_s", "share", "low", "high"),
        rows=[
            (arm.checkpoint, *at)
            for _, arm, curve in drawn
            for at in zip(curve.times, curve.share, curve.low, curve.high, strict=True)
        ],
    )  # fmt: skip


def draw_evidence(
    found: Evidence, first: str, second: str, foreseen: int | None = None, drawn: tuple[int, int] = (0, 1)
) -> Drawing:
    """Draw the e-processes of both directions by pair on a logarithmic scale, with the threshold.

    The axis extends to `foreseen` pairs, if given. `drawn` are the series of the first and the second checkpoint.
    """
    threshold = math.log10(2 / found.alpha)
    paths = [[value / math.log(10) for value in path] for path in (found.first, found.second)]
    end = max(found.pairs, foreseen or 0, 1)
    values = [v for path in paths for v in path]
    x = Scale(0, end, 60, WIDTH - _LEGEND)
    y = Scale(
        min(-2.0, max(-4.0, min(values, default=0.0))),
        max(threshold + 1, *values, 0) if values else threshold + 1,
        230,
        14,
    )
    parts = []
    for power in ticks(y.low, y.high, 6):
        if power == int(power):
            parts.append(line([(x(0), y(power)), (x(end), y(power))], "zero" if power == 0 else "grid"))
            parts.append(words(52, y(power) + 5, f"{10.0**power:g}", "end", "tick"))
    whole = [pair for pair in ticks(0, end, 6) if pair == int(pair)]
    parts += [words(x(pair), 248, number(pair, 6), "middle", "tick") for pair in whole]
    parts.append(words(x(end / 2), 268, "pairs", "middle", "tick"))
    parts.append(line([(x(0), y(threshold)), (x(end), y(threshold))], "wanted"))
    parts.append(words(x(end) + 8, y(threshold) + 5, f"suffices: {2 / found.alpha:g}", class_="tick"))
    labels = []
    for i, path, name in zip(drawn, paths, (first, second), strict=True):
        parts.append(
            line([(x(0), y(0)), *((x(k), y(v)) for k, v in enumerate(path, 1))], f"curve {series(i)}")
        )
        labels.append((y(path[-1] if path else 0), i, f"{name} better"))
    if found.stop is not None:
        parts.append(line([(x(found.stop), 14), (x(found.stop), 230)], "stop"))
        parts.append(words(x(found.stop) + 5, 24, f"pair {found.stop}", class_="tick"))
    parts += _names([*labels, (y(threshold), -1, "")], x(end), 262)
    description = f"Evidence {evidence_text(found)}"
    return drawing(
        WIDTH, 276, "Evidence (e-value) after each pair of trials", description, *parts, kind="evidence",
        columns=("pair", "better", "e_value_log10"),
        rows=[
            (pair, name, value)
            for name, path in zip((first, second), paths, strict=True)
            for pair, value in enumerate(path, 1)
        ],
    )  # fmt: skip


def power(
    curves: Sequence[tuple[int, str, Sequence[tuple[int, float]]]], planned: int, wanted: float, end: int
) -> Drawing:
    """Draw power by trials per checkpoint, with lines at the planned number and the wanted power.

    `curves` has (series, design, points) per design.
    """
    bottom = 230
    x, y = Scale(0, max(end, planned), 60, WIDTH - _LEGEND), Scale(0, 1, bottom, 14)
    parts = []
    for share in range(0, 101, 25):
        parts.append(line([(x(0), y(share / 100)), (x(x.high), y(share / 100))], "grid"))
        parts.append(words(52, y(share / 100) + 5, f"{share}", "end", "tick"))
    parts += [words(x(n), bottom + 18, number(n, 6), "middle", "tick") for n in ticks(0, x.high, 6)]
    parts.append(words(x(x.high / 2), bottom + 38, "trials of each checkpoint", "middle", "tick"))
    parts.append(line([(x(0), y(wanted)), (x(x.high), y(wanted))], "wanted"))
    parts.append(line([(x(planned), 14), (x(planned), bottom)], "stop"))
    parts.append(words(x(planned) + 5, 24, f"planned: {planned}", class_="tick"))
    labels, texts = [], []
    for i, name, points in curves:
        parts.append(line([(x(n), y(chance)) for n, chance in points], f"curve {series(i)}"))
        labels.append((y(points[-1][1]), i, name))
        at = [f"{100 * chance:.0f} % with {n}" for n, chance in points if n == planned or n == points[-1][0]]
        texts.append(f"{name}: {', '.join(at)}")
    if labels:
        parts += _names(labels, x(x.high), bottom)
    title = "Power in percent, by trials of each checkpoint"
    return drawing(
        WIDTH,
        276,
        title,
        "; ".join(texts) or "not computed yet",
        *parts,
        kind="power",
        columns=("design", "trials", "power"),
        rows=[(name, n, chance) for _, name, points in curves for n, chance in points],
    )


def _steps(
    times: Sequence[float], values: Sequence[float], start: float, end: float
) -> list[tuple[float, float]]:
    """Return the points of a step curve from time 0 to `end`; its value is `start` until the first of `times`."""
    points, before = [(0.0, start)], start
    for t, value in zip(times, values, strict=True):
        points += [(t, before), (t, value)]
        before = value
    return [*points, (end, before)]


def _area(upper: Sequence[tuple[float, float]], lower: Sequence[tuple[float, float]]) -> str:
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in [*upper, *reversed(lower)]) + "Z"


def _names(labels: Sequence[tuple[float, int, str]], x: float, lowest: float) -> list[str]:
    """Return marks and names at the ends of curves; `labels` has (height, series, name) per curve.

    A label with a negative series only reserves space.
    """
    gap = 20 + LINE * (max(len(wrapped(name, _LETTERS)) for _, _, name in labels) - 1)
    return [
        mark(i, x + 14, at) + label(x + 26, at + 5, name, _LETTERS)
        for at, i, name in _apart(labels, gap, lowest)
        if i >= 0
    ]


def _apart(
    labels: Sequence[tuple[float, int, str]], gap: float, lowest: float
) -> list[tuple[float, int, str]]:
    """Return the labels moved down until they do not overlap, and up again if they would leave the figure."""
    placed: list[tuple[float, int, str]] = []
    for y, i, name in sorted(labels):
        placed.append((max(y, placed[-1][0] + gap) if placed else y, i, name))
    last = len(placed) - 1
    return [(min(y, lowest - gap * (last - at)), i, name) for at, (y, i, name) in enumerate(placed)]
