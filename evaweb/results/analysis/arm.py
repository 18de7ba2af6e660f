"""Statistics of one checkpoint; each field of `Arm` declares one."""

# ruff: noqa: RUF009 - calls in the body of `Arm` declare its fields
from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from evaweb.results.analysis.json_forms import (
    write_average,
    write_gaffke,
    write_interval,
    write_proportion,
    write_proportions,
    write_rate,
)
from evaweb.results.analysis.outcomes import Interruption, Outcome, TimeHorizon, count_successes, grouped
from evaweb.results.analysis.statistic import Column, statistic, statistics_of, write_all
from evaweb.results.analysis.wording import format_interval
from evaweb.statistics.base import Interval
from evaweb.statistics.bounded import BoundedMean, bounded_mean
from evaweb.statistics.means import Average, average
from evaweb.statistics.milestone_funnel import FunnelStep, funnel
from evaweb.statistics.proportions import Posterior, Proportion, clopper_pearson, posterior, proportion
from evaweb.statistics.rates import Rate, rate
from evaweb.statistics.success_times import Curve, RestrictedMean, cumulative_incidence, restricted_mean
from evaweb.trials.average_text import average_text
from evaweb.trials.failure_text import UNSPECIFIED, failure_text
from runtime.core.sentences import fixed

SEED = 20_260  # seed of all random draws: equal data give equal intervals


@dataclass(frozen=True, slots=True)
class Funnel:
    """Milestone funnel of one scene, with the text of each milestone."""

    scene: str
    labels: tuple[str, ...]
    steps: tuple[FunnelStep, ...]


@dataclass(frozen=True, slots=True)
class FailureMode:
    """Phase and cause of failure ("" if unspecified) of `count` out of `n` trials.

    `interval` is the exact interval of the share `count` / `n`. The interval is valid for a single mode that was named
    beforehand; for the most frequent of many modes it is too optimistic.
    """

    phase: str
    cause: str
    count: int
    n: int
    interval: Interval

    @property
    def words(self) -> str:
        """Failure mode as text for display."""
        return failure_text(self.phase, self.cause) or UNSPECIFIED


@dataclass(frozen=True, slots=True)
class ArmTrials:
    """Trials of one checkpoint in the order of running, from which its statistics are computed."""

    all: Sequence[Outcome]
    interruptions: Sequence[Interruption]
    timing: TimeHorizon

    @property
    def counts(self) -> tuple[int, int]:
        """Number of successes and number of trials."""
        return count_successes(self.all)

    @property
    def scenes(self) -> dict[str, list[Outcome]]:
        """Trials by scene."""
        return grouped(self.all, lambda o: o.scene)

    @property
    def times(self) -> list[float | None]:
        """Times to success [s] of the trials with a known duration."""
        return [self.timing.time(o) for o in self.all if self.timing.known(o)]

    @property
    def exposure(self) -> float:
        """Time of running [s] of the trials with a known duration."""
        return sum(o.duration for o in self.all if o.duration is not None)


def _count_by(rows: Mapping[str, Sequence[Outcome]]) -> dict[str, Proportion]:
    return {key: proportion(*count_successes(trials)) for key, trials in rows.items()}


def _count_interruptions(t: ArmTrials) -> Rate | None:
    exposure = t.exposure + sum(i.duration for i in t.interruptions if i.duration is not None)
    return rate(len(t.interruptions), exposure) if exposure > 0 else None


def _count_speed(t: ArmTrials) -> Rate | None:
    return (
        rate(sum(o.success for o in t.all if o.duration is not None), t.exposure) if t.exposure > 0 else None
    )


def _follow_milestones(t: ArmTrials) -> tuple[Funnel, ...]:
    funnels = []
    for scene, trials in t.scenes.items():
        if stones := trials[0].milestones:
            labels = trials[0].labels or tuple(str(i + 1) for i in range(len(stones)))
            funnels.append(Funnel(scene, labels, tuple(funnel([o.milestones for o in trials]))))
    return tuple(funnels)


def _count_failures(t: ArmTrials) -> tuple[FailureMode, ...]:
    n = len(t.all)
    counts = Counter((o.failure_phase, o.failure) for o in t.all if not o.success)
    modes = (
        FailureMode(phase, cause, count, n, clopper_pearson(count, n))
        for (phase, cause), count in counts.items()
    )
    return tuple(
        sorted(modes, key=lambda mode: (-mode.count, not mode.phase, mode.phase, not mode.cause, mode.cause))
    )


def _write_funnels(funnels: Sequence[Funnel]) -> dict[str, Any]:
    return {
        funnel.scene: [
            {
                "label": label,
                "of_all": write_proportion(step.of_all),
                "of_previous": write_proportion(step.of_previous),
            }
            for label, step in zip(funnel.labels, funnel.steps, strict=True)
        ]
        for funnel in funnels
    }


def _write_times(arm: Arm) -> dict[str, Any]:
    """Return the time to success as JSON: counts, median, curve and restricted mean; null if it is unknown.

    The points of the curve are [time in s, share of successes, lower end, upper end].
    """
    curve, mean = arm.curve, arm.mean_time
    if curve is None or mean is None:
        return {"time_to_success": None}
    points = zip(curve.times, curve.share, curve.low, curve.high, strict=True)
    times = {
        "n": curve.n,
        "successes": curve.successes,
        "until_s": curve.until,
        "median_s": curve.median,
        "curve": [list(point) for point in points],
        "restricted_mean": {
            "value_s": mean.value,
            "gaffke": write_interval(mean.interval),
            "until_s": mean.until,
        },
    }
    return {"time_to_success": times}


def _write_failures(arm: Arm) -> dict[str, Any]:
    """Return the number of failures by cause, summed over all phases, and the list of all failure modes."""
    by_cause: Counter[str] = Counter()
    for mode in arm.failures:
        if mode.cause:
            by_cause[mode.cause] += mode.count
    modes = [
        {
            "failure_phase": mode.phase,
            "failure": mode.cause,
            "count": mode.count,
            "n": mode.n,
            "clopper_pearson": write_interval(mode.interval),
        }
        for mode in arm.failures
    ]
    return {"failures": dict(by_cause), "failure_modes": modes}


def _format_mean(mean: BoundedMean, _: Arm) -> str:
    return f"{100 * mean.value:.0f} % [{format_interval(mean.interval)}]"


def _format_time(time: RestrictedMean, _: Arm) -> str:
    return f"{time.value:.1f} s [{time.interval.low:.1f}, {time.interval.high:.1f}], up to {time.until:.0f} s"


def _format_speed(rate: Rate, _: Arm) -> str:
    return f"{rate.per_hour:.1f} [{rate.interval.low:.1f}, {rate.interval.high:.1f}]"


def _format_between(rate: Rate, _: Arm) -> str:
    low = f"{rate.mean_time_interval.low / 60:.0f}"
    if rate.mean_time is None:
        return f"none in {rate.exposure / 3600:.1f} h, at least {low} min"
    high = rate.mean_time_interval.high
    return f"{rate.mean_time / 60:.0f} min [{low}, {high / 60:.0f}]"


def _format_average(average: Average, arm: Arm) -> str:
    return average_text(average, arm.success.n)


@dataclass(frozen=True, slots=True)
class Arm:
    """Results of one checkpoint.

    Attributes:
        exact: Clopper-Pearson interval of the success rate.
        macro: Mean of the scenes' success rates, with equal weights.
        cells: Success by initial condition.
        curve: Cumulative successes over time [s], up to one horizon for all arms. A failed trial is regarded as not
            having succeeded up to the horizon.
        mean_time: Restricted mean time to success [s] up to the same horizon.
        speed: Successes per hour of running.
        interventions: Interrupted runs per hour of running.
        failures: Failure modes, most frequent first.
        smoothness: SPARC of the measured motion, over the trials with a recording.
        commanded: SPARC of the sent commands.
        series: Index of the colour that the checkpoint has in every figure of its evaluation.
    """

    checkpoint: str
    success: Proportion = statistic(
        lambda t: proportion(*t.counts), write=lambda arm: write_proportion(arm.success)
    )
    exact: Interval | None = statistic(
        lambda t: clopper_pearson(*t.counts),
        "clopper_pearson",
        write_interval,
        column=Column(
            fixed("results.plan_page.exact", "Clopper-Pearson"),
            lambda found, _: f"[{format_interval(found)}]",
        ),
    )
    posterior: Posterior = statistic(
        lambda t: posterior(*t.counts),
        "posterior",
        lambda found: {"a": found.a, "b": found.b, "interval": write_interval(found.interval())},
    )
    score: BoundedMean = statistic(
        lambda t: bounded_mean({"all": [o.score for o in t.all]}, seed=SEED),
        "score",
        write_gaffke,
        column=Column(fixed("results.plan_page.mean_score", "Mean score"), _format_mean),
    )
    macro: BoundedMean = statistic(
        lambda t: bounded_mean(
            {key: [float(o.success) for o in rows] for key, rows in t.scenes.items()}, seed=SEED
        ),
        "macro",
        write_gaffke,
        column=Column(fixed("results.plan_page.macro", "Mean of scenes"), _format_mean),
    )
    scenes: dict[str, Proportion] = statistic(lambda t: _count_by(t.scenes), "scenes", write_proportions)
    cells: dict[str, Proportion] = statistic(
        lambda t: _count_by(grouped(t.all, lambda o: o.condition)), "positions", write_proportions
    )
    funnels: tuple[Funnel, ...] = statistic(_follow_milestones, "milestones", _write_funnels)
    curve: Curve | None = statistic(
        lambda t: cumulative_incidence(t.times, t.timing.until) if t.times else None, write=_write_times
    )
    mean_time: RestrictedMean | None = statistic(
        lambda t: restricted_mean(t.times, t.timing.until, seed=SEED) if t.times else None,
        column=Column(fixed("results.plan_page.mean_time", "Mean time to success"), _format_time),
    )
    speed: Rate | None = statistic(
        _count_speed,
        "successes_per_hour",
        write_rate,
        column=Column(fixed("results.plan_page.speed", "Successes per hour"), _format_speed),
    )
    interventions: Rate | None = statistic(
        _count_interruptions,
        "interruptions_per_hour",
        write_rate,
        column=Column(
            fixed("results.plan_page.between", "Between interruptions"), _format_between, report=False
        ),
    )
    failures: tuple[FailureMode, ...] = statistic(_count_failures, write=_write_failures)
    smoothness: Average | None = statistic(
        lambda t: average([o.smoothness for o in t.all if o.smoothness is not None]),
        "smoothness",
        write_average,
        column=Column(fixed("results.plan_page.smoothness", "Smoothness, SPARC"), _format_average),
    )
    commanded: Average | None = statistic(
        lambda t: average([o.commanded for o in t.all if o.commanded is not None]),
        "smoothness_commanded",
        write_average,
        column=Column("Smoothness as sent", _format_average, page=False),  # there it is in the cell above
    )
    series: int = 0

    @property
    def document(self) -> dict[str, Any]:
        """Results as JSON."""
        return write_all(self)


COLUMNS = {name: row.column for name, row in statistics_of(Arm).items() if row.column is not None}
"""Columns of the table of checkpoints, by statistic."""
