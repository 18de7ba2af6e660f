"""Operating characteristics of designs at assumed rates (power, number of pairs), and pairs needed for a power."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

from evaweb.statistics.base import StatisticsError, check_alpha, check_share
from evaweb.statistics.boundaries import MOST, SHAPES, Boundary, boundary, pair_counts
from evaweb.statistics.designs import ANYTIME, FIXED, RULES
from evaweb.statistics.planning import exact_power, trials_needed

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_RUNS = (
    4000  # number of simulated runs; the e-process depends on the order of outcomes, so it cannot be counted
)
_SEED = 20_260


@dataclass(frozen=True, slots=True)
class DesignPower:
    """Power of a design of at most `pairs` pairs, with the mean and the median number of pairs that it needs."""

    rule: str
    pairs: int
    power: float
    mean: float
    median: int


@lru_cache(maxsize=512)
def design_power(
    rule: str,
    pairs: int,
    p_first: float,
    p_second: float,
    alpha: float,
    margin: float | None = None,
    looks: tuple[int, ...] = (),
) -> DesignPower:
    """Return power and number of pairs of a design of at most `pairs` pairs.

    Both are exact, except for "evidence" (4,000 simulations). With a `margin` the power is that of a non-inferiority
    test: the probability of finding that the first arm's rate is above the second's minus the margin. `looks` are the
    numbers of pairs after which there is a look; if empty, there is one after every pair.
    """
    _check(rule, alpha, p_first, p_second)
    if not 1 <= pairs <= MOST:
        raise StatisticsError(f"{pairs} pairs; allowed: 1 to {MOST}")
    if rule == ANYTIME:
        if margin is not None:
            raise StatisticsError(f"margin = {margin:g} with the design {rule!r}; allowed: none")
        return _simulated(pairs, p_first, p_second, alpha)
    if rule == FIXED and margin is None:
        return DesignPower(rule, pairs, exact_power(pairs, p_first, p_second, alpha), float(pairs), pairs)
    shape, at = ("late", (pairs,)) if rule == FIXED else (rule, looks)  # unused with a single look
    # With a margin, a boundary tests its second arm.
    rates = (p_first, p_second) if margin is None else (p_second, p_first)
    characteristics = _boundary(shape, pairs, alpha, margin, at).operating_characteristics(*rates)
    return DesignPower(
        rule, pairs, characteristics.power, characteristics.mean / 2, characteristics.median // 2
    )


def pairs_needed(
    rule: str, p_first: float, p_second: float, power: float, alpha: float
) -> DesignPower | None:
    """Return the design with the fewest pairs that reaches this power, or None if 250 pairs do not."""
    _check(rule, alpha, p_first, p_second)
    check_share("power", power)
    if p_first == p_second:
        raise StatisticsError(f"p_first = p_second = {p_first}: there is no difference to be found")
    low, reached = 0, 0.0
    high = min(MOST, trials_needed(p_first, p_second, power, alpha))
    while (result := design_power(rule, high, p_first, p_second, alpha)).power < power:
        if high == MOST:
            return None
        low, reached, high = high, result.power, min(MOST, math.ceil(1.15 * high))
    while high - low > 1:
        share = (power - reached) / (result.power - reached)  # power grows almost linearly with the pairs
        middle = min(max(round(low + share * (high - low)), low + 1), high - 1)
        tried = design_power(rule, middle, p_first, p_second, alpha)
        if tried.power >= power:
            high, result = middle, tried
        else:
            low, reached = middle, tried.power
    return result


@dataclass(frozen=True, slots=True)
class Outlook:
    """Comparison of all designs.

    Attributes:
        needs: For each rule in RULES, the design that reaches the wanted power; None if there is no such design.
        chances: For each rule in RULES, the power and number of pairs of the design with the given number of pairs.
        powers: For each gain in the success rate, the powers of the designs in the order of RULES.
    """

    needs: tuple[DesignPower | None, ...]
    chances: tuple[DesignPower, ...]
    powers: tuple[tuple[float, ...], ...]


def outlook(
    p_first: float, p_second: float, power: float, alpha: float, pairs: int, gains: tuple[float, ...]
) -> Outlook:
    """Return the comparison of all designs, if the arms have the rates `p_first` and `p_second`.

    Args:
        p_first: Success rate of the first arm.
        p_second: Success rate of the second arm.
        power: Wanted power, for the number of pairs that each design needs.
        alpha: Alpha of each design.
        pairs: Number of pairs that can be made (0 to 250).
        gains: Further differences of the rates: each is added to `p_first`, and the sum replaces `p_second`.
    """
    needs = tuple(pairs_needed(rule, p_first, p_second, power, alpha) for rule in RULES)
    if not pairs:
        return Outlook(needs, (), ())
    chances = tuple(design_power(rule, pairs, p_first, p_second, alpha) for rule in RULES)
    better = [round(p_first + gain, 9) for gain in gains]
    powers = tuple(
        tuple(design_power(rule, pairs, p_first, rate, alpha).power for rule in RULES) for rate in better
    )
    return Outlook(needs, chances, powers)


@lru_cache(maxsize=128)
def _boundary(shape: str, pairs: int, alpha: float, margin: float | None, at: tuple[int, ...]) -> Boundary:
    return boundary(pair_counts(pairs, at or None), alpha=alpha, shape=shape, margin=margin)


def _simulated(pairs: int, p_first: float, p_second: float, alpha: float) -> DesignPower:
    """Return the power by the e-process of `sequential.success_evidence`, all runs simulated at once."""
    import numpy as np

    chance = np.random.default_rng(_SEED)
    first = chance.random((_RUNS, pairs)) < p_first
    second = chance.random((_RUNS, pairs)) < p_second
    before = np.arange(pairs)

    def gains(worse: NDArray[np.bool_], better: NDArray[np.bool_]) -> NDArray[np.float64]:
        p = (1 + np.cumsum(worse, axis=1) - worse) / (3 + before)
        q = (2 + np.cumsum(better, axis=1) - better) / (3 + before)
        m = (p + q) / 2
        won = np.log(np.where(worse, p / m, (1 - p) / (1 - m)))
        won += np.log(np.where(better, q / m, (1 - q) / (1 - m)))
        return np.asarray(np.cumsum(np.where(p < q, won, 0.0), axis=1))

    reached = np.maximum(gains(second, first), gains(first, second)) >= math.log(2 / alpha)
    ended = reached.any(axis=1)
    needed = np.where(ended, reached.argmax(axis=1) + 1, pairs)
    return DesignPower(ANYTIME, pairs, float(ended.mean()), float(needed.mean()), int(np.median(needed)))


def _check(rule: str, alpha: float, *rates: float) -> None:
    if rule not in RULES:
        raise StatisticsError(f"design = {rule!r}; allowed: {', '.join((FIXED, ANYTIME, *SHAPES))}")
    check_alpha(alpha)
    for rate in rates:
        check_share("rate", rate)
