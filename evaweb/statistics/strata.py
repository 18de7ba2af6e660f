"""Two arms compared over several scenes, so that an easy scene tried more often by one arm decides nothing.

Formulae: Cochran (1954), Mantel and Haenszel (1959) without continuity correction; the mean over scenes, each equally
heavy, with a bootstrap within each arm and scene.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from evaweb.statistics.base import LEVEL, Interval, StatisticsError, check_counts, check_level
from evaweb.statistics.paired import DRAWS

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Table:
    """Successes and trials of both arms in one scene."""

    x1: int
    n1: int
    x2: int
    n2: int

    def __post_init__(self) -> None:
        check_counts(self.x1, self.n1)
        check_counts(self.x2, self.n2)


@dataclass(frozen=True, slots=True)
class Stratified:
    """The comparison over scenes.

    `odds_ratio` is Mantel and Haenszel's (None where it has no bound, or no scene tells), `p` of their test, `crude`
    the difference of the pooled rates, `stratified` that of the scenes' rates, weighted by what each scene tells.
    `reversed` where both have opposite signs: Simpson's paradox, the pooled rates must not be quoted.
    """

    odds_ratio: float | None
    p: float
    crude: float
    stratified: float
    reversed: bool


def mantel_haenszel(tables: Sequence[Table]) -> Stratified:
    """Both arms over the scenes in which both were tried."""
    if not tables:
        raise StatisticsError("no scene in which both arms were tried")
    surplus = variance = above = below = weighted = weights = 0.0
    for t in tables:
        n, successes = t.n1 + t.n2, t.x1 + t.x2
        surplus += t.x1 - t.n1 * successes / n
        variance += t.n1 * t.n2 * successes * (n - successes) / (n * n * (n - 1))
        above += t.x1 * (t.n2 - t.x2) / n
        below += (t.n1 - t.x1) * t.x2 / n
        weight = t.n1 * t.n2 / n
        weighted += weight * (t.x1 / t.n1 - t.x2 / t.n2)
        weights += weight
    if variance > 0:
        from scipy.special import chdtrc

        p = float(chdtrc(1, surplus * surplus / variance))
    else:
        p = 1.0
    ratio = above / below if below > 0 else None
    crude = sum(t.x1 for t in tables) / sum(t.n1 for t in tables) - sum(t.x2 for t in tables) / sum(
        t.n2 for t in tables
    )
    stratified = weighted / weights
    # Beyond rounding: equal rates that differ in the last bit are no paradox.
    return Stratified(
        ratio, p, crude, stratified, crude * stratified < 0 and min(abs(crude), abs(stratified)) > 1e-12
    )


@dataclass(frozen=True, slots=True)
class Mean:
    """A mean with its interval; None where nothing could be drawn anew."""

    value: float
    interval: Interval | None


def macro_average(
    scenes: Mapping[str, Sequence[float]], *, seed: int, level: float = LEVEL, draws: int = DRAWS
) -> Mean:
    """The mean over scenes of each scene's mean outcome (0 to 1); the interval draws trials anew within each scene.

    No interval where all outcomes of every scene are the same: a bootstrap would claim to know without doubt.
    """
    check_level(level)
    import numpy as np

    empty = [name for name, outcomes in scenes.items() if not len(outcomes)]
    if not scenes or empty:
        raise StatisticsError(f"scene {empty[0]!r} has no trial" if empty else "no scene")
    outcomes = {name: np.asarray(values, dtype=float) for name, values in scenes.items()}
    value = float(np.mean([values.mean() for values in outcomes.values()]))
    if all(np.ptp(values) == 0 for values in outcomes.values()):
        return Mean(value, None)
    random = np.random.default_rng(seed)
    means = np.mean([_drawn_means(values, random, draws) for _, values in sorted(outcomes.items())], axis=0)
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    return Mean(value, Interval(float(low), float(high), level))


def _drawn_means(values: NDArray[np.float64], random: np.random.Generator, draws: int) -> NDArray[np.float64]:
    """Means of as many trials as there are, drawn with replacement: by how often each distinct value comes."""
    import numpy as np

    levels, counts = np.unique(values, return_counts=True)
    n = len(values)
    return np.asarray(random.multinomial(n, counts / n, size=draws) @ levels / n)
