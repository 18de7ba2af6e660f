"""Ranking of policies by preference, from pairwise comparisons with ties and an effect of the order of presentation.

Model: Bradley and Terry (1952), ties by Davidson (1970), order by Davidson and Beaver (1977). With log-worths t, the
outcomes of a comparison of i (shown first) and j have the log-weights t_i + g/2, t_j - g/2 and log 2 + f + (t_i +
t_j)/2. The model is a multinomial logit, fitted by Newton's method; if no finite estimate exists, nothing is ranked.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Literal

from evaweb.statistics.base import LEVEL, Interval, StatisticsError, check_level, z_of

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

Outcome = Literal["first", "second", "tie"]
_STEPS = 100
_CLOSE = 1e-8  # largest component of the gradient at the solution
_ROUNDED = 1e-13  # relative rounding error of a likelihood


class NotIdentifiedError(StatisticsError):
    """Error if the comparisons determine no common ranking.

    `components` are sets of policies that can be ranked among themselves. If possible, the sets are ordered such that
    no policy was ever preferred to a policy of an earlier set.
    """

    def __init__(self, text: str, components: Sequence[Sequence[str]]) -> None:
        super().__init__(text)
        self.components = tuple(tuple(part) for part in components)


@dataclass(frozen=True, slots=True)
class Comparison:
    """Comparison of two runs; `first` was run or shown first.

    If several people compared the same two runs, each of these comparisons gets a `weight` below 1, so that together
    they count as one comparison.
    """

    first: str
    second: str
    outcome: Outcome
    weight: float = 1.0


@dataclass(frozen=True, slots=True)
class Contrast:
    """Advantage of the first policy: difference of log-worths, and probability to win if there is no tie."""

    difference: float
    error: float
    interval: Interval
    win_probability: float
    win_interval: Interval


@dataclass(frozen=True, slots=True)
class Preferences:
    """Preferences as fitted by the model.

    Attributes:
        worth: Centred log-worth of each policy.
        error: Standard error of each log-worth.
        contrasts: Contrast of each pair of policies, whose names are in alphabetical order.
        tie: Parameter nu: equal policies tie with probability nu / (1 + nu). None without ties.
        order: Log odds that being shown first adds; None if not fitted.
        order_z: z value of `order`; None if not fitted.
        log_likelihood: Log likelihood of the fit.
    """

    worth: Mapping[str, float]
    error: Mapping[str, float]
    contrasts: Mapping[tuple[str, str], Contrast]
    tie: float | None
    order: float | None
    order_z: float | None
    log_likelihood: float

    @property
    def ranking(self) -> list[str]:
        """Policies, best first; policies that are equal up to rounding are in alphabetical order."""
        return sorted(self.worth, key=lambda name: (-round(self.worth[name], 6), name))

    def rating(self, name: str) -> float:
        """Return 1500 + 200 * centred log-worth, the scale of RoboArena; it is not the scale of chess ratings."""
        return 1500 + 200 * self.worth[name]


def preferences(
    comparisons: Sequence[Comparison], *, order_effect: bool = False, level: float = LEVEL
) -> Preferences:
    """Fit all `comparisons`, with Wald intervals of the contrasts.

    Raises:
        NotIdentifiedError: If the comparisons determine no finite, unique ranking.
    """
    check_level(level)
    import numpy as np

    design = _Design(comparisons, order_effect)
    design.check()
    x, log_likelihood, information = _fit(design)
    k = len(design.names)
    covariance = np.zeros((k, k))
    inverse = np.linalg.inv(information)
    covariance[1:, 1:] = inverse[: k - 1, : k - 1]
    centring = np.eye(k) - 1 / k
    centred = centring @ np.concatenate([[0.0], x[: k - 1]])
    spread = centring @ covariance @ centring.T
    errors = np.sqrt(np.diag(spread))
    z = z_of(level)
    contrasts = {}
    for (i, first), (j, second) in combinations(enumerate(design.names), 2):
        difference = float(centred[i] - centred[j])
        error = math.sqrt(spread[i, i] + spread[j, j] - 2 * spread[i, j])
        ends = (difference - z * error, difference + z * error)
        contrasts[first, second] = Contrast(
            difference,
            error,
            Interval(*ends, level),
            _logistic(difference),
            Interval(_logistic(ends[0]), _logistic(ends[1]), level),
        )
    gamma = float(x[-1]) if order_effect else None
    return Preferences(
        dict(zip(design.names, centred.tolist(), strict=True)),
        dict(zip(design.names, errors.tolist(), strict=True)),
        contrasts,
        math.exp(x[k - 1]) if design.ties else None,
        gamma,
        gamma / math.sqrt(inverse[-1, -1]) if gamma is not None else None,
        log_likelihood,
    )


class _Design:
    """Comparisons as the cells of a multinomial logit, which is linear in the vector x of unknowns.

    The unknowns are the log-worths of all policies except the first, then f (for ties) and g (for the order of
    presentation), as in the module's formula. f is left out without ties, and g without an effect of order.
    """

    def __init__(self, comparisons: Sequence[Comparison], order_effect: bool) -> None:
        import numpy as np

        for comparison in comparisons:
            if comparison.first == comparison.second:
                raise StatisticsError(f"{comparison.first!r} compared with itself")
            if comparison.outcome not in ("first", "second", "tie"):
                raise StatisticsError(f"outcome {comparison.outcome!r}; allowed: first, second, tie")
        self.names = sorted(
            {name for comparison in comparisons for name in (comparison.first, comparison.second)}
        )
        if len(self.names) < 2:
            raise StatisticsError("no comparison of two policies")
        self.wins = Counter(
            (comparison.first, comparison.second)
            if comparison.outcome == "first"
            else (comparison.second, comparison.first)
            for comparison in comparisons
            if comparison.outcome != "tie"
        )
        self.ties = any(comparison.outcome == "tie" for comparison in comparisons)
        cells: defaultdict[tuple[str, str, Outcome], float] = defaultdict(float)
        for comparison in comparisons:
            cells[comparison.first, comparison.second, comparison.outcome] += comparison.weight
        compared = sorted({(first, second) for first, second, _ in cells})
        outcomes: tuple[Outcome, ...] = ("first", "second", "tie") if self.ties else ("first", "second")
        k = len(self.names)
        self.size = k - 1 + self.ties + order_effect
        self.vectors = np.zeros((len(compared), len(outcomes), self.size))
        self.counts = np.array([[cells[*pair, o] for o in outcomes] for pair in compared])
        self.offsets = np.array([0.0, 0.0, math.log(2)][: len(outcomes)])
        place = {
            name: i - 1 for i, name in enumerate(self.names)
        }  # the first policy is the reference: index -1
        for row, (first, second) in zip(self.vectors, compared, strict=True):
            for name, outcome in ((first, 0), (second, 1)):
                if place[name] >= 0:
                    row[outcome, place[name]] += 1
                    if self.ties:
                        row[2, place[name]] += 0.5
            if self.ties:
                row[2, k - 1] = 1
            if order_effect:
                row[0, -1], row[1, -1] = 0.5, -0.5

    def check(self) -> None:
        """Raise NotIdentifiedError unless a finite and unique estimate exists.

        The decision is exact: it uses the rank of the design and a linear program.

        Raises:
            NotIdentifiedError: If no such estimate exists.
            StatisticsError: If the linear program could not be solved.
        """
        import numpy as np
        from scipy.optimize import linprog

        steps = [
            observed - vector
            for vectors, counts in zip(self.vectors, self.counts, strict=True)
            for o, observed in enumerate(vectors)
            if counts[o] > 0
            for a, vector in enumerate(vectors)
            if a != o
        ]
        d = np.array(steps)
        if np.linalg.matrix_rank(d) < self.size:
            raise NotIdentifiedError(
                "the comparisons do not connect all policies, or always showed them in the same order: "
                "no common ranking",
                self.components(),
            )
        solution = linprog(-d.sum(axis=0), A_ub=-d, b_ub=np.zeros(len(d)), bounds=[(-1, 1)] * self.size)
        if not solution.success:
            raise StatisticsError(f"whether a ranking exists could not be decided: {solution.message}")
        if -solution.fun > 1e-9 * len(d):
            raise NotIdentifiedError(
                "some policies, or those shown first, never lost to the others: how much better they are has no bound",
                self.components(),
            )

    def components(self) -> list[list[str]]:
        """Return the sets of policies that are connected by wins in both directions.

        Sets that no policy outside has beaten come first.
        """
        reach = {name: {name} | {loser for (w, loser) in self.wins if w == name} for name in self.names}
        for via in self.names:
            for name in self.names:
                if via in reach[name]:
                    reach[name] |= reach[via]
        parts: list[list[str]] = []
        for name in self.names:
            if not any(name in part for part in parts):
                parts.append([o for o in self.names if o in reach[name] and name in reach[o]])
        return sorted(parts, key=lambda part: (-len(reach[part[0]]), part))


def _fit(design: _Design) -> tuple[NDArray[np.float64], float, NDArray[np.float64]]:
    """Return the maximiser of the log-likelihood, its maximum, and the information matrix there."""
    import numpy as np

    x = np.zeros(design.size)
    if design.ties:
        x[len(design.names) - 1] = math.log(0.5)
    height, gradient, information = _likelihood(design, x)
    for _ in range(_STEPS):
        if np.abs(gradient).max() < _CLOSE:
            return x, height, information
        step = np.linalg.solve(information, gradient)
        length, slope = 1.0, float(gradient @ step)
        least = height - _ROUNDED * abs(height)  # near the maximum the increase is below the rounding error
        while True:
            tried = _likelihood(design, x + length * step)
            if tried[0] >= least + 1e-4 * length * slope or length < 1e-10:
                break
            length /= 2
        x = x + length * step
        height, gradient, information = tried
    raise StatisticsError(
        f"the fit did not converge: gradient {np.abs(gradient).max():g} after {_STEPS} steps"
    )


def _likelihood(
    design: _Design, x: NDArray[np.float64]
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    import numpy as np

    weights = design.vectors @ x + design.offsets
    highest = weights.max(axis=1, keepdims=True)
    normal = highest + np.log(np.exp(weights - highest).sum(axis=1, keepdims=True))
    p = np.exp(weights - normal)
    n = design.counts.sum(axis=1)
    mean = np.einsum("co,cop->cp", p, design.vectors)
    height = float((design.counts * (weights - normal)).sum())
    gradient = np.einsum("co,cop->p", design.counts, design.vectors) - n @ mean
    second = np.einsum("co,cop,coq->cpq", p, design.vectors, design.vectors)
    information = np.einsum("c,cpq->pq", n, second - np.einsum("cp,cq->cpq", mean, mean))
    return height, gradient, information


def _logistic(value: float) -> float:
    return 1 / (1 + math.exp(-value)) if value >= 0 else math.exp(value) / (1 + math.exp(value))
