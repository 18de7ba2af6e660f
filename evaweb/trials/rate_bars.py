"""Figures of the result pages, computed here so that templates only place them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import groupby

from evaweb.statistics.proportions import Proportion
from evaweb.trials.models import Scene
from evaweb.trials.selectors import StatisticsRow

_WIDTH, _PAD = 200, 6


@dataclass(frozen=True, slots=True)
class Bar:
    """Rate with its interval on an axis of 200 units; `words` is the alternative text."""

    rate: float
    low: float
    high: float
    words: str

    @property
    def span(self) -> float:
        """Width of the interval."""
        return round(self.high - self.low, 2)

    @property
    def mark(self) -> float:
        """Left edge of the rate's mark, which is 3 units wide."""
        return round(self.rate - 1.5, 2)


@dataclass(frozen=True, slots=True)
class SceneFigure:
    """Table of one scene: its checkpoints, and the number of scored trials."""

    scene: Scene
    rows: tuple[tuple[StatisticsRow, Bar | None], ...]
    n: int


def rate_bar(found: Proportion) -> Bar | None:
    """Return the bar of a proportion; None if its rate is unknown."""
    if found.rate is None or found.interval is None:
        return None
    text = f"{format_percent(found.rate)} of {found.n}, 95 % interval {format_interval(found)}"
    return Bar(_x(found.rate), _x(found.interval.low), _x(found.interval.high), text)


def scene_figures(rows: Iterable[StatisticsRow]) -> list[SceneFigure]:
    """Return one figure per scene, in the order of the rows."""
    figures = []
    for _, group in groupby(rows, key=lambda row: row.scene.pk):
        members = list(group)
        drawn = tuple((row, rate_bar(row.summary.success)) for row in members)
        figures.append(SceneFigure(members[0].scene, drawn, sum(row.summary.success.n for row in members)))
    return figures


def format_percent(share: float) -> str:
    """Return a fraction as whole percent."""
    return f"{100 * share:.0f} %"


def format_interval(found: Proportion) -> str:
    """Return the ends of the interval in whole percent, without the sign: "49 to 94"."""
    if found.interval is None:
        return ""
    return f"{100 * found.interval.low:.0f} to {100 * found.interval.high:.0f}"


def _x(share: float) -> float:
    return round(_PAD + share * (_WIDTH - 2 * _PAD), 2)
