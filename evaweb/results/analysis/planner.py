"""Calculator of the trials and robot hours that a difference needs, and of what the available time can detect."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

from evaweb.core.errors import EvaError
from evaweb.plans.models import Comparing
from evaweb.serving import computations
from evaweb.statistics.boundaries import MOST
from evaweb.statistics.design_power import DesignPower, Outlook, outlook
from evaweb.statistics.designs import RULES
from evaweb.statistics.planning import detectable
from runtime.core.sentences import Pattern

_COMPARING_ALLOWED = Pattern(
    "results.analysis.planner.comparing_allowed",
    "comparing = {text!r:.80}; allowed: {comparisons}",
)
_ALLOWED_2 = Pattern(
    "results.analysis.planner.allowed_2",
    "{name} = {text!r:.80}; allowed: {low:g} to {high:g}",
)
_RATE_BETTER_BOTH_WITHOUT_DIFFERENCE = Pattern(
    "results.analysis.planner.rate_better_both_without_difference",
    "rate and better are both {rate:g}: without a difference nothing can be found",
)
_RATE_BETTER_ALLOWED_DIFFERENCE_AT = Pattern(
    "results.analysis.planner.rate_better_allowed_difference_at",
    "rate = {rate!r} and better = {better!r}; allowed: a difference of at least {least:g}",
)

LEAST = 0.001  # smallest difference of rates: some four million trials per arm
_GAINS = (0.1, 0.15, 0.2, 0.25, 0.3, 0.4)


@dataclass(frozen=True, slots=True)
class Question:
    """Input of the calculator.

    Attributes:
        rate: Assumed success rate of the weaker checkpoint.
        better: Assumed success rate of the better checkpoint.
        alpha: Error probability of all comparisons together.
        power: Wanted power.
        cycle_s: Time per trial [s].
        checkpoints: Number of checkpoints.
        comparing: Which of them are compared with each other, as in a plan.
        stations: Number of stations that work in parallel.
        hours: Available time at each station [h].
    """

    rate: float = 0.5
    better: float = 0.7
    alpha: float = 0.05
    power: float = 0.8
    cycle_s: float = 90.0
    checkpoints: int = 2
    comparing: str = Comparing.ALL.value
    stations: int = 1
    hours: float = 8.0


COMPARISONS = {  # number of comparisons of `checkpoints` checkpoints
    Comparing.ALL: lambda checkpoints: checkpoints * (checkpoints - 1) // 2,
    Comparing.CONTROL: lambda checkpoints: checkpoints - 1,
    Comparing.PAIR: lambda checkpoints: 1,
}
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


def question_of(given: Mapping[str, str], *, alike: bool = False) -> Question:
    """Return the calculator's input that the query of an address (`given`) describes.

    Both success rates may be equal only if `alike` is set.

    Raises:
        EvaError: If a value is not allowed.
    """
    values: dict[str, Any] = {}
    for field in fields(Question):
        text = given.get(field.name, "").strip()
        if not text:
            continue
        if field.name == "comparing":
            if text not in COMPARISONS:
                raise EvaError(_COMPARING_ALLOWED(text=text, comparisons=", ".join(COMPARISONS)))
            values[field.name] = text
            continue
        low, high = _ALLOWED[field.name]
        try:
            value = int(text) if isinstance(field.default, int) else float(text)
        except ValueError:
            value = None
        if value is None or not low <= value <= high:
            raise EvaError(_ALLOWED_2(name=field.name, text=text, low=low, high=high))
        values[field.name] = value
    question = Question(**values)
    if alike:
        return question
    if question.better == question.rate:
        raise EvaError(_RATE_BETTER_BOTH_WITHOUT_DIFFERENCE(rate=question.rate))
    if abs(question.better - question.rate) < LEAST:
        raise EvaError(
            _RATE_BETTER_ALLOWED_DIFFERENCE_AT(rate=question.rate, better=question.better, least=LEAST)
        )
    return question


def table_of(q: Question, person: Hashable, *, soon: bool = False) -> dict[str, Any]:
    """Return the answers of the calculator to the input `q`.

    They are the trials that each design needs, the difference that can be detected in the available time, and the power
    of each design by gain in the success rate. The computation uses the share of computing time of `person`, which is
    limited.

    Raises:
        Busy: If the share of `person` is used up.
        StillRunning: If the result is not ready in time; with `soon` after a short wait.
    """
    comparisons = COMPARISONS[Comparing(q.comparing)](q.checkpoints)
    alpha = q.alpha / comparisons
    affordable = int(q.hours * 3600 * q.stations / q.cycle_s / q.checkpoints)
    tried = min(affordable, MOST)
    gains = tuple(gain for gain in _GAINS if q.rate + gain <= 1)
    result: Outlook = computations.questions.result(
        person, outlook, q.rate, q.better, q.power, alpha, tried, gains, soon=soon
    )
    return {
        "comparisons": comparisons,
        "alpha": alpha,
        "most": MOST,
        "designs": [
            design_for_power(q, rule, need, alone=comparisons == 1)
            for rule, need in zip(RULES, result.needs, strict=True)
        ],
        "affordable": affordable,
        "tried": tried,
        "chances": [asdict(chance) for chance in result.chances],
        "gains": [
            {"gain": gain, "powers": list(powers)} for gain, powers in zip(gains, result.powers, strict=False)
        ],
        "detectable": detectable(affordable, q.rate, q.power, alpha) if affordable else None,
    }


def design_for_power(q: Question, rule: str, found: DesignPower | None, *, alone: bool) -> dict[str, Any]:
    """Return a design by `rule` that reaches the power, with its maximum and average trials and robot hours.

    `found` is the power and number of pairs of that design. It is None if no such design exists; then the result has
    None as "pairs". The averages are None unless a single pair of checkpoints is compared (`alone`).
    """
    if found is None:
        return {"rule": rule, "pairs": None}
    hour = q.checkpoints * q.cycle_s / 3600
    return {
        **asdict(found),
        # Several comparisons continue until the last one has ended, which at most rates is hardly before all trials
        # are made.
        **({} if alone else {"mean": None, "median": None}),
        "total": found.pairs * q.checkpoints,
        "robot_hours": found.pairs * hour,
        "mean_hours": found.mean * hour if alone else None,
        "hours": found.pairs * hour / q.stations,
    }
