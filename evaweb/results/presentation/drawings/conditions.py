"""Plots of failures: a grid of initial conditions and checkpoints, a Pareto chart of reasons."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from evaweb.results.analysis.analysis import Arm
from evaweb.results.presentation.drawings.svg import (
    LINE,
    Drawing,
    Scale,
    drawing,
    element,
    label,
    legend,
    link,
    series,
    words,
    wrapped,
)
from evaweb.results.presentation.wording import rate_words

_LABELS = 180
_LETTERS = 22  # of a condition or a failure in a line
_CELL = 30


def grid(arms: Sequence[Arm], links: Mapping[tuple[str, str], str]) -> Drawing | None:
    """A row per initial condition, a column per checkpoint: x/n, the darker the more often it succeeded.

    `links` by checkpoint and condition lead to those trials.
    """
    conditions = sorted({name for arm in arms for name in arm.cells}, key=_natural)
    if not conditions or not arms:
        return None
    column = min(130.0, 420 / len(arms))
    letters = int(column / 8)
    lines = max(len(wrapped(arm.checkpoint, letters, 3)) for arm in arms)
    width, top = _LABELS + column * len(arms), 10 + LINE * lines
    parts, said = [], []
    for i, arm in enumerate(arms):
        middle = 5 + LINE * (lines + 1) / 2
        parts.append(label(_LABELS + column * (i + 0.5), middle, arm.checkpoint, letters, "middle", 3))
    for row, condition in enumerate(conditions):
        y = top + _CELL * row
        parts.append(label(_LABELS - 12, y + 20, condition, _LETTERS, "end"))
        for i, arm in enumerate(arms):
            found = arm.cells.get(condition)
            x = _LABELS + column * i
            if found is None or found.rate is None:
                parts.append(words(x + column / 2, y + 20, "–", "middle", "tick"))
                continue
            cell = element(
                "rect", x=x + 1, y=float(y + 1), width=column - 2, height=float(_CELL - 2), class_="cell",
                fill_opacity=f"{0.55 * found.rate:.3f}",
            )  # fmt: skip
            cell += words(x + column / 2, y + 20, f"{found.successes}/{found.n}", "middle", "strong")
            title = f"{arm.checkpoint} at {condition}: {rate_words(found)}"
            parts.append(link(links.get((arm.checkpoint, condition), ""), title, cell))
            said.append(title)
    height = top + _CELL * len(conditions) + 6
    return drawing(
        width, height, "Successes by initial condition", "; ".join(said), *parts, kind="grid-figure"
    )


def pareto(arms: Sequence[Arm], links: Mapping[str, str]) -> Drawing | None:
    """Failures by what was written down for them, the most frequent first, a bar per checkpoint in each.

    Beside each stands how many failures have been named so far, of all.
    """
    totals: dict[str, int] = {}
    for arm in arms:
        for tag, n in arm.failures:
            totals[tag] = totals.get(tag, 0) + n
    if not totals:
        return None
    tags = sorted(totals, key=lambda tag: (-totals[tag], tag))
    most, total = max(totals.values()), sum(totals.values())
    width, row = 600.0, 34
    scale = Scale(0, most, _LABELS, width - 170)
    whose, head = legend([(i, arm.checkpoint) for i, arm in enumerate(arms)], width)
    parts, so_far = [whose], 0
    for at, tag in enumerate(tags):
        y, x = head + row * at, scale(0)
        bars = label(_LABELS - 12, y + 18, tag, _LETTERS, "end")
        for i, arm in enumerate(arms):
            n = dict(arm.failures).get(tag, 0)
            if n:
                wide = scale(n) - scale(0)
                bars += element("rect", x=x, y=y + 3, width=wide, height=20.0, class_=f"beam {series(i)}")
                x += wide
        so_far += totals[tag]
        by = ", ".join(f"{arm.checkpoint} {dict(arm.failures).get(tag, 0)}" for arm in arms)
        bars += words(width - 158, y + 18, f"{totals[tag]} ({so_far} of {total} so far)", class_="value")
        parts.append(link(links.get(tag, ""), f"{tag}: {totals[tag]} of {total} failures ({by})", bars))
    said = "; ".join(f"{tag} {totals[tag]} of {total}" for tag in tags)
    return drawing(width, head + row * len(tags) + 6, "Why trials failed", said, *parts, kind="pareto")


def _natural(condition: str) -> tuple[str, int]:
    scene, _, position = condition.rpartition("/")
    return scene, int(position)
