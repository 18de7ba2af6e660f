"""Comparison of evaluations on simulated benches with a real one of the same checkpoints."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import Any

from evaweb.plans.design import compared
from evaweb.plans.models import Plan
from evaweb.plans.selectors import overlapping_plans
from evaweb.results.analysis.caching import cached_runs
from evaweb.results.analysis.outcomes import Outcome, by_checkpoint
from evaweb.stations.models import Station
from evaweb.statistics.proportions import Proportion, proportion
from evaweb.statistics.simulated_real import Powered, powered_difference, rank_correlation, rank_violation


def is_simulated(plan: Plan) -> bool | None:
    """Return whether all trials were made on simulated benches (True) or on real ones (False); None if mixed
    or without trials.
    """
    kinds = set(plan.handouts.order_by().values_list("trial__station__simulated", flat=True).distinct())
    return kinds.pop() if len(kinds) == 1 else None


def simulated_plans(plan: Plan) -> list[Plan]:
    """Return related plans made on simulated benches that share two checkpoints or more; [] unless this plan
    is real.
    """
    if is_simulated(plan) is not False:
        return []
    simulated_stations = Station.objects.filter(simulated=True)
    rows = overlapping_plans(plan).filter(handouts__trial__station__in=simulated_stations).distinct()
    return [row for row in rows.select_related("owner") if is_simulated(row)]


def compare_with_real(real: Plan, simulated: Plan) -> dict[str, Any]:
    """Return the rates of the checkpoints that both plans tried, and how well their rankings agree.

    The planned differences are estimated again with the help of the simulated trials. Each real trial is matched with a
    simulated trial of the same checkpoint, scene and position, in the order in which they were allocated.
    """
    real_outcomes, simulated_outcomes = (
        by_checkpoint(cached_runs(plan).outcomes) for plan in (real, simulated)
    )
    shared = sorted(set(real_outcomes) & set(simulated_outcomes))
    rates = [(name, _rate(real_outcomes[name]), _rate(simulated_outcomes[name])) for name in shared]
    of_real, of_simulated = (
        [real.rate or 0.0 for _, real, _ in rates],
        [rate.rate or 0.0 for *_, rate in rates],
    )
    return {
        "plan": simulated,
        "rates": rates,
        "rank_correlation": rank_correlation(of_simulated, of_real),
        "rank_violation": rank_violation(of_simulated, of_real),
        "differences": [
            (
                first,
                second,
                powered_difference(
                    _matched(real_outcomes[first], simulated_outcomes[first]),
                    _matched(real_outcomes[second], simulated_outcomes[second]),
                ),
            )
            for first, second in compared(real.document or {})
            if {first, second} <= set(shared)
        ],
    }


def _rate(outcomes: Sequence[Outcome]) -> Proportion:
    return proportion(sum(outcome.success for outcome in outcomes), len(outcomes))


def _matched(real: Sequence[Outcome], simulated: Sequence[Outcome]) -> Powered:
    real_successes, simulated_successes = _by_condition(real), _by_condition(simulated)
    paired = [
        pair
        for condition, rows in real_successes.items()
        for pair in zip(rows, simulated_successes.get(condition, []), strict=False)
    ]
    # Unpaired trials have the same conditions in the same proportions: otherwise an easy condition would gain weight.
    times = min(
        (
            len(simulated_successes.get(condition, [])) // len(rows)
            for condition, rows in real_successes.items()
        ),
        default=0,
    )
    extra = [
        value
        for condition, rows in real_successes.items()
        for value in simulated_successes.get(condition, [])[len(rows) : times * len(rows)]
    ]
    return Powered(paired, extra)


def _by_condition(outcomes: Iterable[Outcome]) -> dict[str, list[float]]:
    successes: dict[str, list[float]] = defaultdict(list)
    for outcome in outcomes:
        successes[outcome.condition].append(float(outcome.success))
    return successes
