"""Exact boundaries for comparing two success rates at several interim looks (group sequential designs).

Given the numbers of successes at a look, every order of the outcomes is equally likely, whatever the common rate is.
So the paths to each table that avoid all earlier stopping regions are counted once, and the probability of a false
stop follows for every common rate, without simulation or approximation. At each look, tables join the stopping region
from the most extreme downwards, as long as the cumulative error does not exceed the alpha that may be spent by then,
at any common rate.

Sources: Kim and DeMets (1987) for spending by a power of the share of trials; Barnard (1945) for growing a region
under the largest error over the nuisance parameter.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

from evaweb.statistics.base import StatisticsError, check_alpha, check_share

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

SHAPES = {"late": 6.0, "early": 1.5}  # alpha spending: exponent of the share of trials
MOST = 250  # greatest number of trials per arm
_RATES = 400  # grid of common rates for the error, uniform in the angle (rate = sin(angle)^2)
_FINE = 40_000  # finer grid of the same kind, for `Boundary.error`
_END = 1e-7  # [rad] distance of the finer grid from 0 and pi/2
_HALVED = 20  # greatest number of bisections of a grid interval
_SAFETY = 0.996  # share of alpha that the grid search may spend; the margin covers rates between grid points
_CELLS = 512  # number of tables evaluated at once, most extreme first
_TIE = 1e-9  # relative; closer values are compared exactly, as integers


@dataclass(frozen=True, slots=True)
class StoppingTable:
    """Number of trials of each arm at a look, and the least extreme table that stops there.

    `least` is (successes of the first arm, successes of the second arm), None if no table stops at this look.
    """

    first: int
    second: int
    least: tuple[int, int] | None


@dataclass(frozen=True, slots=True)
class OperatingCharacteristics:
    """Operating characteristics of a design at given success rates.

    `first_better` and `second_better` are the probabilities of stopping for each arm. `median` and `mean` count the
    trials of both arms over all runs; runs that never stop count with all their trials. `stops` [looks] is the
    probability of stopping at each look.
    """

    first_better: float
    second_better: float
    median: int
    mean: float
    stops: tuple[float, ...]

    @property
    def power(self) -> float:
        """Probability of stopping for either arm."""
        return self.first_better + self.second_better


@dataclass(frozen=True)
class Boundary:
    """Looks of a design and the tables that stop it.

    Without a `margin` the design tests whether the rates differ, two-sided at `alpha`. With a margin it tests whether
    the second arm's rate is not lower than the first's by `margin` or more, one-sided at `alpha`.
    """

    looks: tuple[StoppingTable, ...]
    alpha: float
    margin: float | None = None

    def winner(self, look: int, first: int, second: int) -> str | None:
        """Return the arm ("first" or "second") for which the design stops at a look, or None if it continues.

        With a margin it can stop for the second arm only.

        Args:
            look: Index of the look, from 0.
            first: Successes of the first arm so far.
            second: Successes of the second arm so far.
        """
        at = self.looks[look]
        if at.least is None or not _at_least(first, second, at, self.margin):
            return None
        ahead = self.margin is None and first * at.second > second * at.first
        return "first" if ahead else "second"

    def operating_characteristics(self, p_first: float, p_second: float) -> OperatingCharacteristics:
        """Return the operating characteristics at success rates `p_first` and `p_second`."""
        import numpy as np

        check_share("p_first", p_first)
        check_share("p_second", p_second)
        if not self.looks:
            raise StatisticsError("a design needs at least one look")
        better, worse = [], []
        for table, mass in self._stopping_mass((p_first, p_second)):
            first, second = np.indices(mass.shape)
            ahead = (first * table.second > second * table.first) & (self.margin is None)
            better.append(float(mass[ahead].sum()))
            worse.append(float(mass[~ahead].sum()))
        stops = [won + lost for won, lost in zip(better, worse, strict=True)]
        trials = [table.first + table.second for table in self.looks]
        unstopped = 1.0 - math.fsum(stops)
        so_far, median = 0.0, trials[-1]
        for count, stop in zip(trials, stops, strict=True):
            so_far += stop
            if so_far >= 0.5:
                median = count
                break
        mean = math.fsum(c * s for c, s in zip(trials, stops, strict=True)) + unstopped * trials[-1]
        return OperatingCharacteristics(math.fsum(better), math.fsum(worse), median, mean, tuple(stops))

    def error(self) -> tuple[float, float]:
        """Return the largest probability of a false stop over the null hypothesis, and an upper bound of it.

        The first value is the maximum over a grid of 40,000 rates. The bound holds between grid points too: with rate
        = sin(angle)^2, the arcsine of the square root of a probability changes by at most the square root of the
        number of trials per radian (Cauchy and Schwarz). If that bound exceeds alpha, grid intervals are bisected.
        """
        import numpy as np

        wrong, turn = self._false_stop_mass(), math.sqrt(self.looks[-1].first + self.looks[-1].second)

        def turned(angles: NDArray[np.float64]) -> NDArray[np.float64]:
            null = _Null(self.margin, angles)
            errors = np.sum([null.total(*tables) for tables in wrong], axis=0)
            return np.asarray(np.arcsin(np.sqrt(np.clip(errors, 0.0, 1.0))))

        angles = np.linspace(_END, math.pi / 2 - _END, _FINE)
        at, allowed = turned(angles), math.asin(math.sqrt(self.alpha))
        highest, bound = float(at.max()), max(at[0], at[-1]) + turn * _END
        cells = np.stack([angles[:-1], angles[1:], at[:-1], at[1:]])
        for halved in range(_HALVED + 1):
            most = (cells[2] + cells[3] + turn * (cells[1] - cells[0])) / 2
            doubtful = (most > allowed) & (cells[2:].max(axis=0) <= allowed) & (halved < _HALVED)
            bound = max(bound, float(most[~doubtful].max(initial=0.0)))
            left, right, low, high = cells[:, doubtful]
            if not len(left):
                break
            middle = (left + right) / 2
            at = turned(middle)
            highest = max(highest, float(at.max()))
            cells = np.hstack([[left, middle, low, at], [middle, right, at, high]])
        return math.sin(highest) ** 2, math.sin(min(bound, math.pi / 2)) ** 2

    def _false_stop_mass(self) -> list[tuple[tuple[NDArray[Any], ...], NDArray[np.float64], tuple[int, int]]]:
        """Return stopping tables as (successes by arm, their probabilities at rates of 0.5, trials by arm).

        Without a margin both rates are equal under the null hypothesis, and only the total number of successes
        matters.
        """
        import numpy as np

        if self.margin is not None:
            return [
                (np.nonzero(mass), mass[np.nonzero(mass)], (table.first, table.second))
                for table, mass in self._stopping_mass((0.5, 0.5))
            ]
        gone, trials = np.zeros(1), 0
        for table, mass in self._stopping_mass((0.5, 0.5)):
            for _ in range(table.first + table.second - trials):
                gone = 0.5 * (np.append(gone, 0.0) + np.append(0.0, gone))
            trials = table.first + table.second
            gone += np.bincount(
                np.indices(mass.shape).sum(axis=0).ravel(), mass.ravel(), minlength=trials + 1
            )
        return [((np.arange(trials + 1), np.zeros(trials + 1)), gone, (trials, 0))]

    def _stopping_mass(
        self, rates: tuple[float, float]
    ) -> Iterator[tuple[StoppingTable, NDArray[np.float64]]]:
        """Yield each look with the probability of stopping there at each table: float64 [first + 1, second + 1]."""
        import numpy as np

        alive, before = np.ones((1, 1)), (0, 0)
        for table, region in zip(self.looks, self.regions, strict=True):
            alive = _add_trials(alive, table.first - before[0], table.second - before[1], rates)
            before = (table.first, table.second)
            yield table, np.where(region, alive, 0.0)
            alive = np.where(region, 0.0, alive)

    @cached_property
    def regions(self) -> list[NDArray[np.bool_]]:
        """Stopping region of each look: bool [first + 1, second + 1]."""
        return [_region(table, self.margin) for table in self.looks]


def boundary(
    looks: Sequence[tuple[int, int]],
    *,
    alpha: float = 0.05,
    shape: str = "late",
    margin: float | None = None,
) -> Boundary:
    """Return the boundary of a design with looks at these numbers of trials (first, second); the last look is the end.

    The 32 most recent boundaries are cached.

    Raises:
        StatisticsError: If the looks do not grow, an arm has more than 250 trials, or `alpha`, `shape` or `margin`
            is invalid.
    """
    return _boundary(tuple(_checked(looks)), alpha, shape, margin)


@lru_cache(maxsize=32)
def _boundary(
    counts: tuple[tuple[int, int], ...], alpha: float, shape: str, margin: float | None
) -> Boundary:
    import numpy as np

    check_alpha(alpha)
    if shape not in SHAPES:
        raise StatisticsError(f"shape = {shape!r}; allowed: {', '.join(SHAPES)}")
    if margin is not None and not 0 < margin < 1:
        raise StatisticsError(f"margin = {margin}; allowed: above 0 and below 1")
    null = _Null(margin, np.linspace(0, math.pi / 2, _RATES + 2)[1:-1])
    spent, total = np.zeros(_RATES), sum(counts[-1])
    alive, before, tables = np.ones((1, 1)), (0, 0), []
    for first, second in counts:
        alive = _add_trials(alive, first - before[0], second - before[1], (0.5, 0.5))
        before = (first, second)
        most = _SAFETY * alpha * ((first + second) / total) ** SHAPES[shape]
        least, spent = _least_extreme(alive, (first, second), null, spent, most)
        table = StoppingTable(first, second, least)
        alive = np.where(_region(table, margin), 0.0, alive)
        tables.append(table)
    return Boundary(tuple(tables), alpha, margin)


def pair_counts(pairs: int, at: Sequence[int] | None = None) -> list[tuple[int, int]]:
    """Return the interim looks of a paired design as (trials of the first arm, trials of the second arm).

    Both numbers are equal. There is a look after every pair or, if `at` is given, after each number of pairs in `at`
    and after the last pair.
    """
    chosen = range(1, pairs + 1) if at is None else sorted({*at, pairs})
    return [(pair, pair) for pair in chosen]


def extremeness_of(first: int, n: int, second: int, m: int, margin: float | None) -> tuple[int, int]:
    """Return how extreme a table is, as an exact fraction (numerator, denominator > 0).

    Without a margin: the squared pooled statistic, without the factor that all tables of a look share. With a margin:
    the signed square of (difference + margin) / standard error, after adding one success and one failure to each arm
    (Agresti and Caffo 2000).
    """
    if margin is None:
        successes, trials = first + second, n + m
        if successes in (0, trials):
            return 0, 1
        return (first * m - second * n) ** 2, successes * (trials - successes)
    scale = 10**9
    a, b, n, m = first + 1, second + 1, n + 2, m + 2
    lead = (b * n - a * m) * scale + round(margin * scale) * n * m  # multiplied by scale * n * m
    variance = a * (n - a) * m**3 + b * (m - b) * n**3  # multiplied by n**3 * m**3
    return lead * abs(lead) * n * m, variance * scale * scale


class _Null:
    """Pairs of rates on the border of the null hypothesis: equal rates, or rates that differ by exactly the margin."""

    def __init__(self, margin: float | None, angles: NDArray[np.float64]) -> None:
        import numpy as np

        self.margin = margin
        high = np.sin(angles) ** 2
        first = high if margin is None else margin + (1 - margin) * high
        second = high if margin is None else (1 - margin) * high
        with np.errstate(divide="ignore"):
            self._logs = [np.log(2 * rate) for rate in (first, 1 - first, second, 1 - second)]

    def mass(
        self, cells: tuple[NDArray[Any], ...], even: NDArray[np.float64], trials: tuple[int, int]
    ) -> NDArray[np.float64]:
        """Return the probabilities of tables at all rates of the null hypothesis: float64 [cells, rates].

        `cells` are the successes of each arm, `even` [cells] the probabilities of the tables at rates of 0.5.
        """
        import numpy as np

        if self.margin is None:  # only total successes matter: one exponential per distinct total
            numbers, where = np.unique(cells[0] + cells[1], return_inverse=True)
            return np.asarray(even[:, None] * self.powers(numbers, sum(trials))[where])
        log_first, log_not_first, log_second, log_not_second = self._logs
        (a, b), (n, m) = (of[:, None].astype(float) for of in cells), trials
        with np.errstate(divide="ignore"):
            weights = np.log(even)[:, None]
        return np.asarray(
            np.exp(
                weights + a * log_first + (n - a) * log_not_first + b * log_second + (m - b) * log_not_second
            )
        )

    def powers(self, successes: NDArray[Any], trials: int) -> NDArray[np.float64]:
        """Return the likelihood of these total successes at each common rate, relative to a rate of 0.5: float64 [.,
        rates].
        """
        import numpy as np

        log_first, log_not_first = self._logs[:2]
        number = successes[:, None].astype(float)
        return np.asarray(np.exp(number * log_first + (trials - number) * log_not_first))

    def total(
        self, cells: tuple[NDArray[Any], ...], even: NDArray[np.float64], trials: tuple[int, int]
    ) -> NDArray[np.float64]:
        """Return the total probability of the tables at each rate: float64 [rates]."""
        import numpy as np

        total = np.zeros(len(self._logs[0]))
        for start in range(0, len(even), _CELLS // 8):
            part = slice(start, start + _CELLS // 8)
            total += self.mass((cells[0][part], cells[1][part]), even[part], trials).sum(axis=0)
        return total


def _checked(counts: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    if not counts:
        raise StatisticsError("a design needs at least one look")
    before = (0, 0)
    for count in counts:
        if min(count) < 1 or max(count) > MOST:
            raise StatisticsError(
                f"a look after {count[0]} and {count[1]} trials; allowed: 1 to {MOST} of each arm"
            )
        if count[0] < before[0] or count[1] < before[1] or tuple(count) == before:
            raise StatisticsError(f"a look after {count[0]} and {count[1]} trials follows one after {before}")
        before = (count[0], count[1])
    return [(first, second) for first, second in counts]


def _add_trials(
    alive: NDArray[np.float64], first: int, second: int, rates: tuple[float, float]
) -> NDArray[np.float64]:
    """Return the probabilities of the tables after further trials.

    `alive` are the probabilities of the tables before these trials. `first` and `second` are the numbers of further
    trials of the two arms, and `rates` are the success rates of the arms.
    """
    import numpy as np

    for axis, (more, rate) in enumerate(zip((first, second), rates, strict=True)):
        for _ in range(more):
            wider = np.zeros([size + (at == axis) for at, size in enumerate(alive.shape)])
            low, high = [[slice(None)] * 2 for _ in range(2)]
            low[axis], high[axis] = slice(None, -1), slice(1, None)
            wider[tuple(low)] += alive * (1 - rate)
            wider[tuple(high)] += alive * rate
            alive = wider
    return alive


def _least_extreme(
    alive: NDArray[np.float64],
    trials: tuple[int, int],
    null: _Null,
    spent: NDArray[np.float64],
    most: float,
) -> tuple[tuple[int, int] | None, NDArray[np.float64]]:
    """Return the least extreme table at which the design may stop at this look, and the error at each rate.

    The table is None if the design may not stop at any table. The error includes the stop at this look.
    """
    import numpy as np

    degree = _degrees(*trials, null.margin)
    reached = np.flatnonzero((degree > 0) & (alive > 0))
    order = reached[np.argsort(-degree.ravel()[reached], kind="stable")]
    levels = degree.ravel()[order]
    ends = np.append(
        levels[1:] < levels[:-1] * (1 - _TIE), True
    )  # at the last table of each group of equally extreme ones
    if null.margin is None:
        numbers = np.add(*np.unravel_index(order, alive.shape))
        number, spent = _within(
            null, sum(trials), numbers, alive.ravel()[order], np.flatnonzero(ends), spent, most
        )
        return _least(order[:number], levels, alive.shape, trials, None) if number else None, spent
    least: tuple[int, int] | None = None
    so_far = spent
    for start in range(0, len(order), _CELLS):
        part = slice(start, start + _CELLS)
        cells = np.unravel_index(order[part], alive.shape)
        errors = so_far + np.cumsum(null.mass(cells, alive[cells], trials), axis=0)
        within = errors.max(axis=1) <= most
        allowed = len(within) if within.all() else int(np.argmin(within))
        whole = np.flatnonzero(ends[part][:allowed])
        if len(whole):
            spent = errors[whole[-1]]
            least = _least(order[: start + whole[-1] + 1], levels, alive.shape, trials, null.margin)
        if allowed < len(within):
            break
        so_far = errors[-1]
    return least, spent


def _within(
    null: _Null,
    trials: int,
    numbers: NDArray[np.intp],
    even: NDArray[np.float64],
    ends: NDArray[np.intp],
    spent: NDArray[np.float64],
    most: float,
) -> tuple[int, NDArray[np.float64]]:
    """Return how many tables can join the stopping region, and the error at each rate with these tables included.

    This function is for a design that tests whether both rates are equal. The tables are ordered from the most extreme
    downwards. The last table that joins must be at one of the indices in `ends`. The error grows with the number of
    tables at every rate, so the number is found by bisection.

    Args:
        null: Null hypothesis, with the grid of common rates.
        trials: Trials of both arms together.
        numbers: Total successes of each table.
        even: Probability of each table at rates of 0.5.
        ends: Indices of the tables that may be the last one.
        spent: Error at each rate so far.
        most: Largest error allowed.
    """
    import numpy as np

    likelier = null.powers(np.arange(trials + 1), trials)
    before, low, high = spent, 0, len(ends)
    while low < high:
        middle = (low + high + 1) // 2
        upto = ends[middle - 1] + 1
        error = before + np.bincount(numbers[:upto], even[:upto], minlength=trials + 1) @ likelier
        if error.max() <= most:
            low, spent = middle, error
        else:
            high = middle - 1
    return int(ends[low - 1]) + 1 if low else 0, spent


def _least(
    order: NDArray[np.intp],
    levels: NDArray[np.float64],
    shape: tuple[int, ...],
    trials: tuple[int, int],
    margin: float | None,
) -> tuple[int, int]:
    """Return the least extreme table in `order`, which is sorted from the most extreme table downwards.

    The last tables may be equally extreme up to rounding. Of these, the least extreme is determined in exact
    arithmetic.
    """
    import numpy as np

    alike = order[levels[: len(order)] <= levels[len(order) - 1] * (1 + _TIE)]
    tables = [tuple(int(at) for at in np.unravel_index(index, shape)) for index in alike]

    def degree(table: tuple[int, ...]) -> Fraction:
        return Fraction(*extremeness_of(table[0], trials[0], table[1], trials[1], margin))

    first, second = min(sorted(tables), key=degree)
    return first, second


def _at_least(first: int, second: int, table: StoppingTable, margin: float | None) -> bool:
    assert table.least is not None
    over, under = extremeness_of(first, table.first, second, table.second, margin)
    least_over, least_under = extremeness_of(
        table.least[0], table.first, table.least[1], table.second, margin
    )
    return over * least_under >= least_over * under


def _region(table: StoppingTable, margin: float | None) -> NDArray[np.bool_]:
    """Return the stopping region of a look: bool [first + 1, second + 1].

    Tables that rounding could misclassify are compared exactly, as integers.
    """
    import numpy as np

    degree = _degrees(table.first, table.second, margin)
    if table.least is None:
        return np.zeros(degree.shape, dtype=bool)
    level = degree[table.least]
    region = degree > level * (1 + _TIE)
    for first, second in np.argwhere(np.abs(degree - level) <= _TIE * level):
        region[first, second] = _at_least(int(first), int(second), table, margin)
    return np.asarray(region)


def _degrees(n: int, m: int, margin: float | None) -> NDArray[np.float64]:
    """Return the extremeness (see `extremeness_of`) of every table of a look: float64 [n + 1, m + 1]."""
    import numpy as np

    a: NDArray[np.float64] = np.arange(n + 1.0)[:, None]
    b: NDArray[np.float64] = np.arange(m + 1.0)[None, :]
    if margin is None:
        successes = a + b
        under = successes * (n + m - successes)
        return np.asarray(
            np.divide((a * m - b * n) ** 2, under, out=np.zeros((n + 1, m + 1)), where=under > 0)
        )
    p, q = (a + 1) / (n + 2), (b + 1) / (m + 2)
    lead = q - p + margin
    return np.asarray(lead * np.abs(lead) / (p * (1 - p) / (n + 2) + q * (1 - q) / (m + 2)))
