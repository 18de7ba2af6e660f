"""The tables of result pages: checkpoints, pairs, scenes and single trials."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from django.urls import reverse

from evaweb.plans.models import Plan
from evaweb.results.analysis import caching
from evaweb.results.analysis.analysis import Analysis, Arm
from evaweb.results.analysis.filters import Chosen, choices
from evaweb.results.analysis.outcomes import Outcome, paired
from evaweb.results.presentation.addresses import beside_address, trials_address
from evaweb.results.presentation.drawings import conditions
from evaweb.results.presentation.wording import ends
from evaweb.statistics.bounded import Mean
from evaweb.statistics.proportions import Proportion
from evaweb.trials.failure_words import NOT_SAID
from evaweb.trials.failures import FIELDS
from evaweb.trials.figures import average_words
from evaweb.trials.models import Trial

MOST_PAIRS = 200


@dataclass(frozen=True, slots=True)
class Row:
    """A line of a table: what it is of, x of n, and where its trials are."""

    name: str
    found: Proportion
    address: str


def arm_rows(plan: Plan, analysis: Analysis, only: Chosen) -> list[dict[str, Any]]:
    """The table of checkpoints, best first."""
    return [
        {
            "arm": arm,
            "letters": analysis.letters[arm.checkpoint],
            "address": trials_address(plan, only, checkpoint=arm.checkpoint),
            "successes": trials_address(plan, only, checkpoint=arm.checkpoint, success="yes"),
            "exact": ends(arm.exact) if arm.exact else "",
            "score": _mean(arm.score),
            "macro": _mean(arm.macro),
            "time": _time(arm),
            "speed": arm.speed
            and f"{arm.speed.per_hour:.1f} [{arm.speed.interval.low:.1f}, {arm.speed.interval.high:.1f}]",
            "between": _between(arm),
            "smoothness": average_words(arm.smoothness, arm.success.n),
            "commanded": average_words(arm.commanded, arm.success.n),
        }
        for arm in analysis.arms
    ]


def scene_rows(plan: Plan, analysis: Analysis, scene: str, only: Chosen) -> list[Row]:
    """Each checkpoint on one scene."""
    return [
        Row(
            arm.checkpoint,
            arm.scenes[scene],
            trials_address(plan, only, checkpoint=arm.checkpoint, scene=scene),
        )
        for arm in analysis.arms
        if scene in arm.scenes
    ]


@dataclass(frozen=True, slots=True)
class Cell:
    """How many trials, and where they are."""

    count: int
    address: str


def failure_tables(
    analysis: Analysis, order: Mapping[str, Sequence[str]], address: Callable[..., str]
) -> list[dict[str, Any]]:
    """Of each checkpoint that failed a Pareto chart, and a table of causes by phase with its sums.

    `order`: the lab's words by field; others follow, what was not said comes last. `address` of trials by their
    checkpoint, failure_phase and failure, of which any may be left out.
    """
    return [_failure_table(i, arm, order, address) for i, arm in enumerate(analysis.arms) if arm.failures]


def _failure_table(
    i: int, arm: Arm, order: Mapping[str, Sequence[str]], address: Callable[..., str]
) -> dict[str, Any]:
    phases = _ordered({mode.phase for mode in arm.failures}, order["failure_phase"])
    causes = _ordered({mode.cause for mode in arm.failures}, order["failure"])

    def cell(phase: str | None, cause: str | None) -> Cell:
        """Of one phase and cause; None for all."""
        chosen = [m for m in arm.failures if phase in (None, m.phase) and cause in (None, m.cause)]
        named = {"failure_phase": phase, "failure": cause}
        where = {field: words or NOT_SAID for field, words in named.items() if words is not None}
        return Cell(sum(m.count for m in chosen), address(checkpoint=arm.checkpoint, **where))

    rows = [(cause or NOT_SAID, [cell(phase, cause) for phase in (*phases, None)]) for cause in causes]
    links = {(mode.phase, mode.cause): cell(mode.phase, mode.cause).address for mode in arm.failures}
    return {
        "checkpoint": arm.checkpoint,
        "n": arm.success.n,
        "pareto": conditions.pareto(i, arm, links),
        "head": [phase or NOT_SAID for phase in phases],
        "rows": [*rows, ("all", [cell(phase, None) for phase in (*phases, None)])],
    }


def _ordered(found: set[str], order: Sequence[str]) -> list[str]:
    place = {words: i for i, words in enumerate(order)}
    return sorted(found, key=lambda words: (not words, place.get(words, len(place)), words))


def pair_rows(first: Sequence[Outcome], second: Sequence[Outcome]) -> list[dict[str, Any]]:
    """Both trials of each block, with where they are played side by side."""
    pairs = paired(first, second)
    episodes = dict(
        Trial.objects.filter(
            pk__in=[run.trial for pair in pairs[:MOST_PAIRS] for run in (pair.first, pair.second)],
            episode__isnull=False,
        ).values_list("pk", "episode_id")
    )
    rows = []
    for number, pair in enumerate(pairs, start=1):
        played = [episodes[run.trial] for run in (pair.first, pair.second) if run.trial in episodes]
        rows.append({"number": number, "pair": pair, "beside": beside_address(played)})
    return rows


def trial_row(trial: Trial) -> dict[str, Any]:
    """A trial of a list, and from which second on its recording shows what went wrong."""
    outcomes = list(trial.verdict.outcomes.all()) if trial.verdict else []
    times = [at for row in outcomes if row.reached and (at := getattr(row, "at_s", None)) is not None]
    failed = bool(trial.verdict and not trial.verdict.success)
    moment = max(times, default=None) if failed else None
    replay = reverse("replay", args=[trial.episode_id]) if trial.episode_id else ""
    return {
        "trial": trial,
        "reached": sum(row.reached for row in outcomes),
        "milestones": len(outcomes),
        "replay": replay + (f"?t={moment:.1f}" if replay and moment is not None else ""),
        "moment": moment,
    }


def trial_choices(plan: Plan) -> dict[str, list[str]]:
    """Values that the list of trials can be narrowed to."""
    runs = caching.runs_of(plan).outcomes
    failed = [run for run in runs if not run.success]
    return {
        **choices(runs),
        "checkpoint": sorted({run.checkpoint for run in runs}),
        **{field: sorted({getattr(run, field) or NOT_SAID for run in failed}) for field in FIELDS},
    }


def _mean(found: Mean) -> str:
    return f"{100 * found.value:.0f} % [{ends(found.interval)}]"


def _time(arm: Arm) -> str:
    if arm.mean_time is None:
        return ""
    mean = arm.mean_time
    return f"{mean.value:.1f} s [{mean.interval.low:.1f}, {mean.interval.high:.1f}], up to {mean.until:.0f} s"


def _between(arm: Arm) -> str:
    found = arm.interventions
    if found is None:
        return ""
    low = f"{found.mean_time_interval.low / 60:.0f}"
    if found.mean_time is None:
        return f"none in {found.exposure / 3600:.1f} h, at least {low} min"
    high = found.mean_time_interval.high
    return f"{found.mean_time / 60:.0f} min [{low}, {high / 60:.0f}]"
