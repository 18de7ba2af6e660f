"""Tables of the result pages: checkpoints, pairs, scenes and single trials."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from django.urls import reverse

from evaweb.episodes.models import Episode
from evaweb.plans.models import PlanState
from evaweb.results.analysis.analysis import Analysis
from evaweb.results.analysis.arm import COLUMNS, Arm
from evaweb.results.analysis.filters import filter_choices
from evaweb.results.analysis.outcomes import Outcome, Pair
from evaweb.results.presentation.addresses import side_by_side_url, trials_address
from evaweb.results.presentation.drawings import conditions
from evaweb.results.presentation.plan_result import PlanResult
from evaweb.results.ratings.footage import is_watchable
from evaweb.results.selectors import TrialQuery
from evaweb.serving.lists import (
    SEARCH,
    UNSEEN,
    Column,
    Filter,
)
from evaweb.statistics.proportions import Proportion
from evaweb.trials.failure_text import UNSPECIFIED
from evaweb.trials.failures import FIELDS
from evaweb.trials.models import Trial, TrialStatus

MOST_PAIRS = 200


@dataclass(frozen=True, slots=True)
class Row:
    """Row of a table: name, x of n, and the address of the trials."""

    name: str
    found: Proportion
    address: str


def arm_rows(result: PlanResult) -> list[dict[str, Any]]:
    """Return the table of checkpoints, best first, each with its result after later corrections of scores."""
    plan, only, analysis = result.plan, result.only, result.analysis
    return [
        {
            "arm": arm,
            "corrected": result.corrected.get(arm.checkpoint),
            "letters": analysis.letters.get(arm.checkpoint, ""),
            "address": trials_address(plan, only, checkpoint=arm.checkpoint),
            "successes": trials_address(plan, only, checkpoint=arm.checkpoint, success="yes"),
            "cells": [(name, column, column.text(arm, name)) for name, column in COLUMNS.items()],
            "commanded": COLUMNS["commanded"].text(arm, "commanded"),
        }
        for arm in analysis.arms
    ]


def scene_rows(result: PlanResult, scene: str) -> list[Row]:
    """Return the rows of the checkpoints on one scene."""
    return [
        Row(
            arm.checkpoint,
            arm.scenes[scene],
            trials_address(result.plan, result.only, checkpoint=arm.checkpoint, scene=scene),
        )
        for arm in result.analysis.arms
        if scene in arm.scenes
    ]


@dataclass(frozen=True, slots=True)
class Cell:
    """Number of trials, and the address of their list."""

    count: int
    address: str


def failure_tables(
    analysis: Analysis, order: Mapping[str, Sequence[str]], address: Callable[..., str]
) -> list[dict[str, Any]]:
    """Return for each checkpoint with failures a Pareto chart, and a table of causes by phase with sums.

    `order` has the lab's terms by field; other terms follow, unspecified ones come last. `address` returns the address
    of a list of trials; its arguments checkpoint, failure_phase and failure are optional.
    """
    return [_failure_table(arm, order, address) for arm in analysis.arms if arm.failures]


def _failure_table(
    arm: Arm, order: Mapping[str, Sequence[str]], address: Callable[..., str]
) -> dict[str, Any]:
    phases = _ordered({mode.phase for mode in arm.failures}, order["failure_phase"])
    causes = _ordered({mode.cause for mode in arm.failures}, order["failure"])

    def cell(phase: str | None, cause: str | None) -> Cell:
        """Return the count and the trials' address for a phase and a cause; None stands for all phases or causes."""
        chosen = [m for m in arm.failures if phase in (None, m.phase) and cause in (None, m.cause)]
        named = {"failure_phase": phase, "failure": cause}
        where = {field: value or UNSPECIFIED for field, value in named.items() if value is not None}
        return Cell(sum(m.count for m in chosen), address(checkpoint=arm.checkpoint, **where))

    rows = [(cause or UNSPECIFIED, [cell(phase, cause) for phase in (*phases, None)]) for cause in causes]
    links = {(mode.phase, mode.cause): cell(mode.phase, mode.cause).address for mode in arm.failures}
    return {
        "checkpoint": arm.checkpoint,
        "n": arm.success.n,
        "pareto": conditions.draw_pareto(arm, links),
        "head": [phase or UNSPECIFIED for phase in phases],
        "rows": [*rows, ("all", [cell(phase, None) for phase in (*phases, None)])],
    }


def _ordered(values: set[str], order: Sequence[str]) -> list[str]:
    place = {value: i for i, value in enumerate(order)}
    return sorted(values, key=lambda value: (not value, place.get(value, len(place)), value))


@dataclass(frozen=True, slots=True)
class Side:
    """Trial of a pair, with its recording if there is one."""

    run: Outcome
    episode: Episode | None

    @property
    def video(self) -> str:
        """Address of the first camera's video; "" if this machine has no images."""
        if not is_watchable(self.episode):
            return ""
        return reverse("episode-video", args=[self.episode.uuid, self.episode.cameras[0]])

    @property
    def still(self) -> float:
        """Time of the last image [s]."""
        if self.episode is None or not self.episode.fps:
            return 0.0
        return max(0.0, round((self.episode.frames - 0.5) / self.episode.fps, 3))


def differs(pair: Pair) -> bool:
    """Return True if one trial succeeded or reached a milestone that the other did not."""
    return (pair.first.success, pair.first.milestones) != (pair.second.success, pair.second.milestones)


def pair_rows(pairs: Sequence[tuple[int, Pair]]) -> list[dict[str, Any]]:
    """Return both trials of each numbered block with their recordings, and the address of synchronous playback."""
    trials = [run.trial for _, pair in pairs for run in (pair.first, pair.second)]
    episodes = {row.trial.pk: row for row in Episode.objects.filter(trial__in=trials).select_related("trial")}
    rows = []
    for number, pair in pairs:
        sides = [Side(run, episodes.get(run.trial)) for run in (pair.first, pair.second)]
        address = side_by_side_url([side.episode.uuid for side in sides if side.episode])
        rows.append({"number": number, "pair": pair, "sides": sides, "beside": address})
    return rows


def trial_row(trial: Trial) -> dict[str, Any]:
    """Return one row of a list of trials, as a dict for the template.

    For a failure, "moment" is the time [s] in the recording at which the last milestone was reached, so that the
    failure occurred after it; None if unknown.
    """
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


def trial_filters(runs: Sequence[Outcome]) -> list[Filter]:
    """Return the filters of the list of these trials; `TrialQuery` rejects unknown values."""
    failed = [run for run in runs if not run.success]
    values = {
        **filter_choices(runs),
        "checkpoint": sorted({run.checkpoint for run in runs}),
        "success": ["yes", "no"],
        **{field: sorted({getattr(run, field) or UNSPECIFIED for run in failed}) for field in FIELDS},
    }
    labels = {"failure_phase": "Phase", "failure": "Failure"}
    names = ("checkpoint", "scene", "position", "success", "failure_phase", "failure", "station", "operator")
    return [
        *(
            Filter(
                name,
                labels.get(name, name.capitalize()),
                [(value, value) for value in values[name]],
                strict=False,
            )
            for name in names
        ),
        Filter(
            "status",
            "Status",
            [(EVERY, "every attempt"), *TrialStatus.choices],
            any="those that count",
            strict=False,
        ),
        Filter("missed", "Without the milestone", kind=UNSEEN),
        Filter("reached", "With the milestone", kind=UNSEEN),
    ]


def question_of(chosen: Mapping[str, str]) -> TrialQuery:
    """Return the query of trials for the selected filters; without a status it is for trials that count."""
    status = chosen["status"] or TrialStatus.SCORED.value
    return TrialQuery(**{**chosen, "status": "" if status == EVERY else status})


EVERY = "every"
TRIAL_COLUMNS = (
    Column("trial", "Trial", ("pk",), lambda row: row.pk),
    Column("code", "Code", ("handout__code",), lambda row: row.handout.code),
    Column("checkpoint", "Checkpoint", ("checkpoint__name",), lambda row: row.checkpoint.name),
    Column(
        "condition",
        "Condition",
        ("scene__name", "position__number"),
        lambda row: f"{row.scene.name}/{row.position.number}",
    ),
    Column(
        "success",
        "Success",
        ("verdict__success",),
        lambda row: row.verdict and row.verdict.success,
        down=True,
    ),
    Column(
        "milestones",
        "Milestones",
        ("verdict__score",),
        lambda row: row.verdict and row.verdict.score,
        down=True,
    ),
    Column("time", "Time", ("duration_s",), lambda row: row.duration_s, number=True),
    Column(
        "failure",
        "Failure, note",
        ("verdict__failure_phase", "verdict__failure"),
        lambda row: row.verdict and row.verdict.why,
    ),
    Column(
        "station", "Station, operator", ("station__name", "operator__username"), lambda row: row.station.name
    ),
    Column("operator", "Operator", cell=lambda row: row.operator.get_username(), hidden=True),
    Column("status", "Status", cell=lambda row: row.status, hidden=True),
    Column("video", "Video"),
)
PLAN_FILTERS = (
    Filter("state", "State", PlanState.choices),
    Filter("words", "Words", kind=SEARCH, hint="title or name"),
)
PLAN_COLUMNS = (
    Column("title", "Evaluation", ("title", "version"), lambda row: row.plan.title),
    Column("name", "Name", cell=lambda row: row.plan.name, hidden=True),
    Column("version", "Version", cell=lambda row: row.plan.version, hidden=True),
    Column("state", "State", ("state",), lambda row: row.plan.state),
    Column("counted", "Trials that count", cell=lambda row: row.counted),
    Column("foreseen", "Trials foreseen", cell=lambda row: row.foreseen, hidden=True),
    Column("attempts", "Attempts", cell=lambda row: row.attempts, number=True),
    Column("left", "Hours left", cell=lambda row: row.hours_left, number=True),
    Column("blind", "Blind", ("blind",), lambda row: row.plan.blind),
    Column("owner", "Owner", ("owner__username",), lambda row: row.plan.owner.get_username()),
    Column("frozen", "Frozen", ("frozen_at",), lambda row: row.plan.frozen_at, down=True),
)
