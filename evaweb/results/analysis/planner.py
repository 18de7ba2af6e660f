"""Trials and robot hours that a difference needs; what the trials there is time for miss."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from evaweb.errors import EvaError
from evaweb.statistics.planning import approximate_power, detectable, exact_power, trials_needed

EXACT = 100  # trials an arm up to which the exact power is computed while somebody waits
LEAST = 0.001  # difference of rates: some four million trials an arm
_GAINS = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5)


@dataclass(frozen=True, slots=True)
class Question:
    """Rates of the weaker and of the better checkpoint, alpha, power, time per trial [s], and what there is of it.

    `checkpoints` are compared, on `stations` at once; `hours` are those that there is time for at each.
    """

    rate: float = 0.5
    better: float = 0.7
    alpha: float = 0.05
    power: float = 0.8
    cycle_s: float = 90.0
    checkpoints: int = 2
    stations: int = 1
    hours: float = 8.0


_ALLOWED: dict[str, tuple[float, float]] = {
    "rate": (0.0, 1.0),
    "better": (0.0, 1.0),
    "alpha": (0.0001, 0.5),
    "power": (0.5, 0.999),
    "cycle_s": (1.0, 36_000.0),
    "checkpoints": (2, 50),
    "stations": (1, 100),
    "hours": (0.1, 10_000.0),
}


def question_of(given: Mapping[str, str]) -> Question:
    """The question of an address; EvaError names what is not allowed."""
    found: dict[str, Any] = {}
    for field in fields(Question):
        text = given.get(field.name, "").strip()
        if not text:
            continue
        low, high = _ALLOWED[field.name]
        try:
            value = int(text) if isinstance(field.default, int) else float(text)
        except ValueError:
            value = None
        if value is None or not low <= value <= high:
            raise EvaError(f"{field.name} = {text!r:.80}; allowed: {low:g} to {high:g}")
        found[field.name] = value
    question = Question(**found)
    if question.better == question.rate:
        raise EvaError(
            f"rate and better are both {question.rate:g}: without a difference nothing can be found"
        )
    if abs(question.better - question.rate) < LEAST:
        raise EvaError(
            f"rate = {question.rate!r} and better = {question.better!r}; allowed: a difference of at least {LEAST:g}"
        )
    return question


def table_of(q: Question) -> dict[str, Any]:
    """Numbers of the question, by the normal law, and by Barnard's own power where that can be computed."""
    n = trials_needed(q.rate, q.better, q.power, q.alpha)
    affordable = int(q.hours * 3600 * q.stations / q.cycle_s / q.checkpoints)
    return {
        "n": n,
        "total": n * q.checkpoints,
        "robot_hours": n * q.checkpoints * q.cycle_s / 3600,
        "hours": n * q.checkpoints * q.cycle_s / 3600 / q.stations,
        "exact": exact_power(n, q.rate, q.better, q.alpha) if n <= EXACT else None,
        "most": EXACT,
        "affordable": affordable,
        "detectable": detectable(affordable, q.rate, q.power, q.alpha) if affordable else None,
        "chance": approximate_power(affordable, q.rate, q.better, q.alpha) if affordable else 0.0,
        "gains": [
            (gain, needed, needed * q.checkpoints * q.cycle_s / 3600 / q.stations)
            for gain in _GAINS
            if q.rate + gain <= 1
            for needed in [trials_needed(q.rate, q.rate + gain, q.power, q.alpha)]
        ],
    }
