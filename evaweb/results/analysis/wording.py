"""Wording of results: percentages with n and interval, comparisons in one sentence."""

from __future__ import annotations

from evaweb.statistics.base import Interval
from evaweb.statistics.difference import Difference
from evaweb.statistics.planning import POWER, detectable
from evaweb.statistics.proportions import Proportion
from evaweb.statistics.sequential import Evidence


def rate_words(found: Proportion) -> str:
    """Return the rate as text, for example "46/50, 92 % [81, 97]".

    A percentage is never shown without n and interval.
    """
    if found.rate is None or found.interval is None:
        return "no trial"
    return f"{found.successes}/{found.n}, {100 * found.rate:.0f} % [{format_interval(found.interval)}]"


def format_interval(interval: Interval, factor: float = 100) -> str:
    """Return both ends as signed numbers, multiplied by `factor`; by default in percent."""
    return f"{_signed(factor * interval.low)}, {_signed(factor * interval.high)}"


def format_points(found: Difference) -> str:
    """Return a difference as text, for example "36 points [19, 51]"."""
    return f"{_signed(100 * found.value)} points [{format_interval(found.interval)}]"


def signed_points(share: float) -> str:
    """Return a share as text, for example "+36 points"."""
    return f"{100 * share:+.0f} points".replace("-", "−")


def probability(p: float) -> str:
    """Return a probability as papers print it, for example "0.03" or "< 0.001"."""
    return "< 0.001" if p < 0.001 else f"{p:.3f}" if p < 0.1 else f"{p:.2f}"


def p_words(p: float) -> str:
    """Return a p-value as text, for example "p = 0.03" or "p < 0.001"."""
    return f"p {text}" if (text := probability(p)).startswith("<") else f"p = {text}"


def undetectable_gain_sentence(n: int, rate: float | None, alpha: float) -> str:
    """Return a sentence on the gain over `rate` that `n` trials per arm could not have detected."""
    if rate is None or n < 1:
        return "Without trials nothing could be detected."
    gain = detectable(n, min(rate, 0.999), POWER, alpha)
    base = f"With {n} trials of each checkpoint, and a rate of {100 * rate:.0f} % for the weaker one"
    if gain is None:
        share = f"{1 - POWER:.0%} of such evaluations"
        return f"{base}, even the largest possible gain would be missed in more than {share}."
    return (
        f"{base}, a gain below {100 * gain:.0f} points would be missed in more than one evaluation of five "
        f"(alpha {alpha:g}, power {POWER:.0%})."
    )


def evidence_text(found: Evidence) -> str:
    """Return the state of the evidence as text.

    The text says since which pair the evidence suffices or, if it does not, how strong it is.
    """
    if found.stop is not None:
        return f"suffices since pair {found.stop}"
    if not found.pairs:
        return "no pair yet"
    e = max(found.first[-1], found.second[-1])
    return f"not enough after {found.pairs} pairs (e = {_power(e)}, wanted {2 / found.alpha:.0f})"


def anytime_text(found: Interval | None, pairs: int) -> str:
    """Return a confidence sequence as text, for example "[−3, 55] points, of 40 pairs"."""
    return (
        f"[{format_interval(found)}] points, of {pairs} pairs"
        if found
        else "no one difference fits all pairs"
    )


def _power(log_e: float) -> str:
    return f"{2.718281828459045**log_e:.2g}" if log_e < 12 else f"10^{log_e / 2.302585:.0f}"


def _signed(value: float) -> str:
    return f"{value:.0f}".replace("-0", "0").replace("-", "−")
