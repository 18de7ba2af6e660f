"""Plots of success rates: intervals, posteriors as violins, and one difference."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from evaweb.results.analysis.arm import Arm
from evaweb.results.analysis.comparison import Comparison
from evaweb.results.analysis.wording import format_points, rate_words
from evaweb.results.presentation.drawings.svg import (
    LINE,
    PROPORTION,
    Drawing,
    Scale,
    counted,
    drawing,
    element,
    label,
    line,
    link,
    mark,
    percent_axis,
    series,
    words,
    wrapped,
)
from evaweb.statistics.proportions import Proportion

WIDTH = 600
_NAMES = 180
_LETTERS = 22  # characters per line of a name
_POINTS = 120  # points of a violin's outline


def draw_intervals(
    title: str, rows: Sequence[tuple[str, Proportion, str]], order: Mapping[str, int]
) -> Drawing:
    """Draw one row per (name, x of n, address): mark at the rate, band over its 95 % interval, and the numbers.

    `order` maps names to the index of their series; names that it lacks are drawn as series 0.
    """
    step = 36
    height = step * len(rows) + 44
    scale = Scale(0, 1, _NAMES, WIDTH - 170)
    parts = [percent_axis(scale, height - 26, 6)]
    for i, (name, rate, address) in enumerate(rows):
        y, at = 26 + step * i, order.get(name, 0)
        row = label(_NAMES - 12, y + 5, name, _LETTERS, "end")
        if rate.rate is not None and rate.interval is not None:
            low, high = scale(rate.interval.low), scale(rate.interval.high)
            row += element(
                "rect", x=low, y=float(y - 5), width=high - low, height=10.0, class_=f"band {series(at)}"
            )
            row += mark(at, scale(rate.rate), y)
        row += words(WIDTH - 158, y + 5, rate_words(rate), class_="value")
        parts.append(link(address, f"{name}: {rate_words(rate)}", row))
    text = "; ".join(f"{name} {rate_words(rate)}" for name, rate, _ in rows)
    return drawing(
        WIDTH, height, title, text, *parts, kind="intervals",
        columns=("checkpoint", *PROPORTION), rows=[(name, *counted(rate)) for name, rate, _ in rows],
    )  # fmt: skip


def draw_violins(arms: Sequence[Arm], letters: Mapping[str, str]) -> Drawing:
    """Draw the posterior of each checkpoint's rate with a uniform prior as violins with a common scale."""
    row = 64
    height = row * len(arms) + 40
    scale = Scale(0, 1, _NAMES, WIDTH - 60)
    shares = [i / _POINTS for i in range(_POINTS + 1)]
    densities = [arm.posterior.density(shares) for arm in arms]
    highest = max((max(d) for d in densities), default=1.0)
    parts, rows = [percent_axis(scale, height - 26, 6)], []
    for i, (arm, density) in enumerate(zip(arms, densities, strict=True)):
        y = 8 + row * (i + 0.5)
        half = Scale(
            0, math.sqrt(highest), 0, row * 0.46
        )  # square root, so that wide posteriors stay visible next to narrow ones
        dense = [(p, d) for p, d in zip(shares, density, strict=True) if d > 1e-3 * highest]
        upper = [(scale(p), y - half(math.sqrt(d))) for p, d in dense]
        lower = [(x, 2 * y - top) for x, top in reversed(upper)]
        interval, n = arm.posterior.interval(), arm.success
        rows.append(
            (arm.checkpoint, n.successes, n.n, arm.posterior.mean, interval.low, interval.high,
             letters.get(arm.checkpoint, ""))
        )  # fmt: skip
        lines = [(row, "") for row in wrapped(arm.checkpoint, _LETTERS)]
        lines.append((f"{arm.success.successes}/{arm.success.n}", "tick"))
        top = y + 5 - LINE * (len(lines) - 1) / 2
        parts.append(
            element("path", d=_outline([*upper, *lower]), class_=f"violin {series(arm.series)}")
            + line([(scale(interval.low), y), (scale(interval.high), y)], f"whisker {series(arm.series)}")
            + mark(arm.series, scale(arm.posterior.mean), y, 4)
            + "".join(
                words(_NAMES - 12, top + LINE * at, row, "end", class_)
                for at, (row, class_) in enumerate(lines)
            )
            + words(WIDTH - 48, y + 5, letters.get(arm.checkpoint, ""), class_="letters")
        )
    text = "; ".join(
        f"{arm.checkpoint} mean {arm.posterior.mean:.0%}, 95 % from {arm.posterior.interval().low:.0%} to "
        f"{arm.posterior.interval().high:.0%}, letters {letters.get(arm.checkpoint, '')}"
        for arm in arms
    )
    return drawing(
        WIDTH, height, "Posterior of the success rates", text, *parts, kind="violins",
        columns=("checkpoint", "successes", "trials", "posterior_mean", "low", "high", "letters"),
        rows=rows,
    )  # fmt: skip


def draw_difference(found: Comparison) -> Drawing:
    """Draw the first checkpoint's rate minus the second's in percentage points.

    The interval is Newcombe's; the axis is centred at 0.
    """
    height = 114
    scale = Scale(-1, 1, 30, WIDTH - 30)
    interval = found.difference.interval
    parts = [
        words(30, 20, "Difference of the success rates, percentage points, 95 % Newcombe", class_="small"),
        label(30, 104, f"← {found.second} is better", _LETTERS + 12, "start"),
        label(WIDTH - 30, 104, f"{found.first} is better →", _LETTERS + 12, "end"),
    ]
    for at in range(-100, 101, 25):
        x = scale(at / 100)
        parts.append(line([(x, 30), (x, 68)], "zero" if at == 0 else "grid"))
        parts.append(words(x, 84, f"{at:+d}".replace("-", "−") if at else "0", "middle", "tick"))
    low, high = scale(interval.low), scale(interval.high)
    parts.append(element("rect", x=low, y=42.0, width=high - low, height=12.0, class_=f"band {series(None)}"))
    parts.append(mark(None, scale(found.difference.value), 48))
    text = f"{found.first} minus {found.second}: {format_points(found.difference)}"
    return drawing(
        WIDTH, height, "Difference of the success rates in points", text, *parts, kind="difference",
        columns=("first", "second", "difference", "low", "high"),
        rows=[(found.first, found.second, found.difference.value, interval.low, interval.high)],
    )  # fmt: skip


def _outline(dots: Sequence[tuple[float, float]]) -> str:
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in dots) + "Z"
