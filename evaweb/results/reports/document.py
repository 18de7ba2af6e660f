"""Analysis as JSON, for REST, for reports, and for the program that recomputes them.

Intervals are [low, high]; those under `gaffke` are from random draws and are reproduced only approximately. Points of
a curve are [time, share of successes, low, high].
"""

from __future__ import annotations

from collections import Counter
from typing import Any

from evaweb.results.analysis.analysis import Analysis, Arm, Comparison, Standing
from evaweb.statistics.base import Interval
from evaweb.statistics.bounded import BoundedMean
from evaweb.statistics.difference import Difference
from evaweb.statistics.means import Average
from evaweb.statistics.proportions import Proportion
from evaweb.statistics.rates import Rate
from evaweb.statistics.sequential import Evidence


def analysis_document(analysis: Analysis) -> dict[str, Any]:
    """Return the complete analysis."""
    return {
        "n": analysis.n,
        "alpha": analysis.alpha,
        "letters": dict(analysis.letters),
        "arms": {arm.checkpoint: arm_document(arm) for arm in analysis.arms},
        "comparisons": [comparison_document(comparison) for comparison in analysis.comparisons],
        "recipes": {found.name: {"rates": found.rates, **_run(found.mean)} for found in analysis.recipes},
    }


def _run(mean: Average) -> dict[str, Any]:
    return {"runs": mean.n, "mean": mean.value, "student": _ends(mean.interval)}


def arm_document(arm: Arm) -> dict[str, Any]:
    """Return the results of one checkpoint."""
    return {
        **proportion_document(arm.success),
        "clopper_pearson": _ends(arm.exact),
        "posterior": {
            "a": arm.posterior.a,
            "b": arm.posterior.b,
            "interval": _ends(arm.posterior.interval()),
        },
        "score": _mean(arm.score),
        "macro": _mean(arm.macro),
        "scenes": {name: proportion_document(found) for name, found in arm.scenes.items()},
        "positions": {name: proportion_document(found) for name, found in arm.cells.items()},
        "milestones": {
            funnel.scene: [
                {
                    "label": label,
                    "of_all": proportion_document(step.of_all),
                    "of_previous": proportion_document(step.of_previous),
                }
                for label, step in zip(funnel.labels, funnel.steps, strict=True)
            ]
            for funnel in arm.funnels
        },
        "time_to_success": _time(arm),
        "successes_per_hour": _rate(arm.speed),
        "interruptions_per_hour": _rate(arm.interventions),
        "failures": _by_cause(arm),
        "failure_modes": [
            {
                "failure_phase": mode.phase,
                "failure": mode.cause,
                "count": mode.count,
                "n": mode.n,
                "clopper_pearson": _ends(mode.interval),
            }
            for mode in arm.failures
        ],
        "smoothness": _average(arm.smoothness),
        "smoothness_commanded": _average(arm.commanded),
    }


def comparison_document(found: Comparison) -> dict[str, Any]:
    """Return the comparison of two checkpoints, the first minus the second."""
    return {
        "first": found.first,
        "second": found.second,
        "standing": found.standing.value,
        "difference": {"value": found.difference.value, "newcombe": _ends(found.difference.interval)},
        "barnard": found.test
        and {"statistic": found.test.statistic, "p": found.test.p, "holm": found.corrected},
        "probability_better": found.better,
        "pairs": found.pairs,
        "mcnemar": found.paired
        and {
            "first_only": found.paired.first_only,
            "second_only": found.paired.second_only,
            "pairs": found.paired.pairs,
            "p": found.paired.p,
        },
        "scores": found.scored
        and {"pairs": found.scored.pairs, "value": found.scored.value, "p": found.scored.p},
        "over_conditions": _clustered(found.clustered),
        "over_scenes": found.stratified
        and {
            "odds_ratio": found.stratified.odds_ratio,
            "p": found.stratified.p,
            "crude": found.stratified.crude,
            "stratified": found.stratified.stratified,
            "reversed": found.stratified.reversed,
        },
        "within": {name: {"p": one.p, "strata": one.strata} for name, one in found.within.items()},
        "by_scene": {
            "differences": {
                name: {"value": one.value, "newcombe": _ends(one.interval)}
                for name, one in found.scenes.items()
            },
            "interaction_p": found.interaction,
        },
        "evidence": _evidence(found.evidence),
        "score_evidence": _evidence(found.score_evidence),
        "anytime": None
        if found.standing is Standing.OPEN
        else {
            "level": 1 - found.alpha,
            "success": _ends(found.anytime),
            "score": _ends(found.score_anytime),
        },
        "sooner": found.time_test
        and {"pairs": found.time_test.pairs, "value_s": found.time_test.value, "p": found.time_test.p},
    }


def proportion_document(found: Proportion) -> dict[str, Any]:
    """Return x of n with its Wilson interval; null if n is 0."""
    return {
        "successes": found.successes,
        "n": found.n,
        "rate": found.rate,
        "wilson": _ends(found.interval),
    }


def _ends(interval: Interval | None) -> list[float] | None:
    return None if interval is None else [interval.low, interval.high]


def _mean(found: BoundedMean) -> dict[str, Any]:
    return {"value": found.value, "gaffke": _ends(found.interval)}


def _average(found: Average | None) -> dict[str, Any] | None:
    return None if found is None else {"n": found.n, "mean": found.value, "student": _ends(found.interval)}


def _clustered(found: Difference | None) -> dict[str, Any] | None:
    return None if found is None else {"value": found.value, "gaffke": _ends(found.interval)}


def _by_cause(arm: Arm) -> dict[str, int]:
    """Return the number of failures by specified cause, over all phases."""
    found: Counter[str] = Counter()
    for mode in arm.failures:
        if mode.cause:
            found[mode.cause] += mode.count
    return dict(found)


def _rate(found: Rate | None) -> dict[str, Any] | None:
    if found is None:
        return None
    return {
        "events": found.events,
        "exposure_s": found.exposure,
        "per_hour": found.per_hour,
        "garwood": _ends(found.interval),
    }


def _time(arm: Arm) -> dict[str, Any] | None:
    curve, mean = arm.curve, arm.mean_time
    if curve is None:
        return None
    points = zip(curve.times, curve.share, curve.low, curve.high, strict=True)
    return {
        "n": curve.n,
        "successes": curve.successes,
        "until_s": curve.until,
        "median_s": curve.median,
        "curve": [list(point) for point in points],
        "restricted_mean": mean
        and {"value_s": mean.value, "gaffke": _ends(mean.interval), "until_s": mean.until},
    }


def _evidence(found: Evidence | None) -> dict[str, Any] | None:
    if found is None:
        return None
    return {
        "pairs": found.pairs,
        "log_e_first": list(found.first),
        "log_e_second": list(found.second),
        "p_first": found.p_first[-1] if found.pairs else 1.0,
        "p_second": found.p_second[-1] if found.pairs else 1.0,
        "stop": found.stop,
        "winner": found.winner,
    }
