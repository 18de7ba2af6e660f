"""Plots of failures: grid of initial conditions by checkpoint, Pareto charts of phases and causes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from evaweb.results.analysis.arm import Arm
from evaweb.results.analysis.wording import format_interval, rate_words
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
    number,
    series,
    ticks,
    words,
    wrapped,
)

_LABELS = 180
_LETTERS = 22  # characters per line of a condition or failure
_CELL = 30


def draw_grid(arms: Sequence[Arm], links: Mapping[tuple[str, str], str]) -> Drawing | None:
    """Draw x/n by initial condition (rows) and checkpoint (columns), darker for more successes.

    `links` maps (checkpoint, condition) to the address of a list of these trials. Return None without trials.
    """
    conditions = sorted({name for arm in arms for name in arm.cells}, key=_natural)
    if not conditions or not arms:
        return None
    column = min(130.0, 420 / len(arms))
    letters = int(column / 8)
    lines = max(len(wrapped(arm.checkpoint, letters, 3)) for arm in arms)
    width, top = _LABELS + column * len(arms), 10 + LINE * lines
    parts, texts = [], []
    for i, arm in enumerate(arms):
        middle = 5 + LINE * (lines + 1) / 2
        parts.append(label(_LABELS + column * (i + 0.5), middle, arm.checkpoint, letters, "middle", 3))
    for row, condition in enumerate(conditions):
        y = top + _CELL * row
        parts.append(label(_LABELS - 12, y + 20, condition, _LETTERS, "end"))
        for i, arm in enumerate(arms):
            rate = arm.cells.get(condition)
            x = _LABELS + column * i
            if rate is None or rate.rate is None:
                parts.append(words(x + column / 2, y + 20, "–", "middle", "tick"))
                continue
            cell = element(
                "rect", x=x + 1, y=float(y + 1), width=column - 2, height=float(_CELL - 2), class_="cell",
                fill_opacity=f"{0.55 * rate.rate:.3f}",
            )  # fmt: skip
            cell += words(x + column / 2, y + 20, f"{rate.successes}/{rate.n}", "middle", "strong")
            title = f"{arm.checkpoint} at {condition}: {rate_words(rate)}"
            parts.append(link(links.get((arm.checkpoint, condition), ""), title, cell))
            texts.append(title)
    height = top + _CELL * len(conditions) + 6
    return drawing(
        width, height, "Successes by initial condition", "; ".join(texts), *parts, kind="grid-figure",
        columns=("checkpoint", "condition", *PROPORTION),
        rows=[
            (arm.checkpoint, condition, *counted(arm.cells[condition]))
            for arm in arms for condition in conditions if condition in arm.cells
        ],
    )  # fmt: skip


def draw_pareto(arm: Arm, links: Mapping[tuple[str, str], str]) -> Drawing:
    """Draw the failures of one checkpoint by phase and cause, most frequent first.

    Bars are shares of all its trials, with intervals as lines. `links` maps (phase, cause) to the address of a list of
    these trials.
    """
    total, so_far = sum(mode.count for mode in arm.failures), 0
    width, row = 600.0, 34
    height = row * len(arm.failures) + 30
    # Rounded up to 10 %, so that the longest interval fits.
    most = min(1.0, math.ceil(10 * max((mode.interval.high for mode in arm.failures), default=1.0)) / 10)
    scale = Scale(0, most, _LABELS, width - 165)
    parts, texts = [_percents(scale, height - 26)], []
    for at, mode in enumerate(arm.failures):
        y, so_far = float(row * at), so_far + mode.count
        share = f"{mode.count}/{mode.n}, {100 * mode.count / mode.n:.0f} % [{format_interval(mode.interval)}]"
        bar = label(_LABELS - 12, y + 18, mode.words, _LETTERS, "end")
        bar += element(
            "rect", x=scale(0), y=y + 4, width=scale(mode.count / mode.n) - scale(0), height=18.0,
            class_=f"beam {series(arm.series)}",
        )  # fmt: skip
        bar += line([(scale(mode.interval.low), y + 13), (scale(mode.interval.high), y + 13)], "error")
        bar += words(width - 155, y + 18, share, class_="value small")
        title = f"{mode.words}: {share}; {so_far} of {total} failures so far"
        parts.append(link(links.get((mode.phase, mode.cause), ""), title, bar))
        texts.append(title)
    return drawing(
        width, height, f"Why trials of {arm.checkpoint} failed", "; ".join(texts), *parts, kind="pareto",
        columns=("checkpoint", "phase", "cause", "failures", "trials", "low", "high"),
        rows=[
            (arm.checkpoint, mode.phase, mode.cause, mode.count, mode.n, mode.interval.low, mode.interval.high)
            for mode in arm.failures
        ],
    )  # fmt: skip


def _percents(scale: Scale, y: float) -> str:
    """Return an axis of shares that may end below 100 %."""
    shares = ticks(0, 100 * scale.high, 4)
    return "".join(
        line([(scale(share / 100), 0.0), (scale(share / 100), y)], "grid")
        + words(
            scale(share / 100),
            y + 16,
            number(share) + (" %" if share == shares[-1] else ""),
            "middle",
            "tick",
        )
        for share in shares
    )


def _natural(condition: str) -> tuple[str, int]:
    scene, _, position = condition.rpartition("/")
    return scene, int(position)
