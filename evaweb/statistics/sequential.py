"""Anytime-valid evidence: it may be examined, and the evaluation stopped, after every pair of trials.

An e-process is the wealth of a bet against "both arms are equal"; the expected wealth is at most 1 while this is true.
By Ville's inequality the wealth reaches 1/alpha with probability at most alpha, however often it is examined. Both
directions are tested, each at alpha/2. Sources: Turner and Gruenwald (2023), safe two-sample tests, for success and
failure; Waudby-Smith and Ramdas (2023), betting, for partial credit.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from evaweb.statistics.base import check_alpha, check_share

ALPHA = 0.05
BET_FRACTIONS = (0.1, 0.3, 0.5, 0.7, 0.9)  # share of its wealth that each gambler bets on each pair


@dataclass(frozen=True, slots=True)
class Evidence:
    """Evidence of a sequence of pairs for both directions, after each pair.

    Attributes:
        first: Log e-value that the first arm is better [pairs].
        second: Log e-value that the second arm is better [pairs].
        p_first: Anytime-valid probability of the first direction, the running minimum of 1/e [pairs].
        p_second: Anytime-valid probability of the second direction [pairs].
        alpha: Two-sided alpha; each direction has half of it.
        stop: Number of pairs after which `p_first` or `p_second` first was at most alpha/2; None if neither was.
        winner: Arm ("first" or "second") of the direction that reached alpha/2; None if neither did.
    """

    first: tuple[float, ...]
    second: tuple[float, ...]
    p_first: tuple[float, ...]
    p_second: tuple[float, ...]
    alpha: float
    stop: int | None
    winner: str | None

    @property
    def pairs(self) -> int:
        """Number of pairs."""
        return len(self.first)

    @property
    def p(self) -> float:
        """Two-sided probability: twice the smaller of the last `p_first` and `p_second`, but at most 1.

        1 before the first pair.
        """
        return min(1.0, 2 * min(self.p_first[-1], self.p_second[-1])) if self.pairs else 1.0


def success_evidence(pairs: Iterable[tuple[bool, bool]], alpha: float = ALPHA) -> Evidence:
    """Return the evidence of pairs (first succeeded, second succeeded) in the order in which they were run.

    Each pair may have its own success rate, as when both arms start from the same initial condition. The bet that the
    evidence is computed from is fair whenever both arms of a pair have the same rate, whatever that rate is. The order
    must be the true one, and pairs must not be omitted.
    """
    check_alpha(alpha)
    first, second = [], []
    log_first = log_second = 0.0
    n = wins1 = wins2 = 0
    for first_success, second_success in pairs:
        # The favoured arm has the prior Beta(2, 1), the other Beta(1, 2): so there is a bet before the first trial.
        log_first += _factor((1 + wins2) / (3 + n), (2 + wins1) / (3 + n), second_success, first_success)
        log_second += _factor((1 + wins1) / (3 + n), (2 + wins2) / (3 + n), first_success, second_success)
        first.append(log_first)
        second.append(log_second)
        n, wins1, wins2 = n + 1, wins1 + bool(first_success), wins2 + bool(second_success)
    return _evidence(first, second, alpha)


def _factor(p: float, q: float, worse: bool, better: bool) -> float:
    """Return by how much one pair of trials increases the logarithm of the e-value for "the better arm is better".

    Args:
        p: Success rate of the worse arm, as predicted before this pair.
        q: Success rate of the better arm, as predicted before this pair.
        worse: Whether the trial of the worse arm succeeded.
        better: Whether the trial of the better arm succeeded.
    """
    if p >= q:
        return 0.0
    m = (p + q) / 2
    return _log(p, worse) + _log(q, better) - _log(m, worse) - _log(m, better)


def _log(rate: float, success: bool) -> float:
    return math.log(rate if success else 1 - rate)


def score_evidence(pairs: Iterable[tuple[float, float]], alpha: float = ALPHA) -> Evidence:
    """Return the evidence of pairs (score of the first, score of the second), each 0 to 1, in the order of running."""
    check_alpha(alpha)
    scores = list(pairs)
    for first_score, second_score in scores:
        check_share("score", first_score)
        check_share("score", second_score)
    return _evidence(_log_wealth([a - b for a, b in scores]), _log_wealth([b - a for a, b in scores]), alpha)


def _log_wealth(differences: Sequence[float]) -> list[float]:
    """Return the log wealth after each of `differences` (-1 to 1) of gamblers who bet that their mean is above 0.

    The money is divided equally among gamblers with different stakes, so that a good stake need not be guessed.
    """
    worths, path = [0.0] * len(BET_FRACTIONS), []
    for d in differences:
        worths = [worth + math.log1p(stake * d) for worth, stake in zip(worths, BET_FRACTIONS, strict=True)]
        most = max(worths)
        path.append(most + math.log(math.fsum(math.exp(worth - most) for worth in worths) / len(worths)))
    return path


def _evidence(first: list[float], second: list[float], alpha: float) -> Evidence:
    p_first, p_second = _anytime(first), _anytime(second)
    for pair, (value_first, value_second) in enumerate(zip(p_first, p_second, strict=True), start=1):
        if min(value_first, value_second) <= alpha / 2:
            winner = "first" if value_first <= value_second else "second"
            return Evidence(tuple(first), tuple(second), tuple(p_first), tuple(p_second), alpha, pair, winner)
    return Evidence(tuple(first), tuple(second), tuple(p_first), tuple(p_second), alpha, None, None)


def _anytime(path: Sequence[float]) -> list[float]:
    lowest, p_values = 1.0, []
    for log_e in path:
        lowest = min(lowest, math.exp(-log_e) if log_e > 0 else 1.0)
        p_values.append(lowest)
    return p_values
