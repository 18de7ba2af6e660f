"""Outcome of a trial from a rater's milestones; pure functions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from evaweb.core.errors import EvaError
from evaweb.trials.models import Milestone
from runtime.core.sentences import Pattern, fixed

_SUCCESS_MISSING_NO_MILESTONE_THIS = fixed(
    "trials.verdicts.success_missing_no_milestone_this",
    "success is missing: no milestone of this scene is required, so say true or false",
)
_SUCCESS_CONTRADICTS_REQUIRED_MILESTONES_WHICH = Pattern(
    "trials.verdicts.success_contradicts_required_milestones_which",
    "success = {success} contradicts the required milestones, which say {implied}: correct the "
    "milestones, or leave success out",
)
_MILESTONE_NOT_ONE_THIS_SCENE = Pattern(
    "trials.verdicts.milestone_not_one_this_scene",
    "milestone {key!r} is not one of this scene; allowed: {names}",
)
_MILESTONE_ALLOWED_TRUE_FALSE = Pattern(
    "trials.verdicts.milestone_allowed_true_false",
    "milestone {key}: {value!r}; allowed: true, false",
)
_MILESTONE_NOT_ANSWERED_SAY_TRUE = Pattern(
    "trials.verdicts.milestone_not_answered_say_true",
    "milestone {missing} is not answered: say true or false for each of {names}",
)
_TRUTH_SILENT = Pattern(
    "trials.verdicts.truth_silent",
    "milestone {text!r} is {name!r} in the bench's truth, which reports {reports}: a person scores it",
)
_TIMES_MILESTONE_NOT_ONE_THIS = Pattern(
    "trials.verdicts.times_milestone_not_one_this",
    "times: milestone {key!r} is not one of this scene; allowed: {known}",
)
_TIMES_MILESTONE_ALLOWED_SECONDS_FROM = Pattern(
    "trials.verdicts.times_milestone_allowed_seconds_from",
    "times: milestone {key}: {at!r}; allowed: seconds from 0, or null",
)
_TIMES_HAS_TIME_S_BUT = Pattern(
    "trials.verdicts.times_has_time_s_but",
    "times: {text!r} has the time {at:g} s, but was not reached",
)
_REACHED_AFTER_S_COUNTS_WITHIN = Pattern(
    "trials.verdicts.reached_after_s_counts_within",
    "{text!r} was reached after {at:g} s and counts within {limit:g} s: leave it unticked",
)
_TICKED_BEFORE_NOT_MILESTONES_THIS = Pattern(
    "trials.verdicts.ticked_before_not_milestones_this",
    "{text!r} is ticked and {missed!r} before it is not: the milestones of this scene come one after "
    "the other",
)
_REACHED_AFTER_S_BEFORE_ONE = Pattern(
    "trials.verdicts.reached_after_s_before_one",
    "{text!r} was reached after {at:g} s, before the one that comes first",
)

LONGEST_NOTE = 8000  # longest note [characters]
LONGEST_FAILURE = 60
LONGEST_RUN_S = 24 * 3600.0


@dataclass(frozen=True, slots=True)
class ScoredOutcome:
    """Milestones with whether and when they were reached [s], the fraction of their points, and success."""

    reached: tuple[tuple[Milestone, bool, float | None], ...]
    score: float
    success: bool


def score_outcome(
    milestones: Sequence[Milestone],
    ticks: Mapping[object, object],
    success: bool | None,
    *,
    times: Mapping[object, object] | None = None,
    ordered: bool = False,
    fails: bool = False,
) -> ScoredOutcome:
    """Return the outcome of one trial from `ticks`: milestone id -> reached, for each of the scene's milestones.

    A trial is a success if all required milestones are reached. If no milestone is required, `success` must be given.

    Args:
        times: Milestone id -> time of reaching it [s after the start of the run], if known. A milestone reached
            after its time limit does not count and must not be ticked.
        ordered: Whether each milestone requires all before it.
        fails: The trial counts as a failure whatever was reached, unless `success` is given as True.

    Raises:
        EvaError: Milestones are missing or unknown, or the answers contradict each other.
    """
    answers = _answers(milestones, ticks)
    when = _times(milestones, answers, times or {})
    reached = tuple((m, answers[m.pk], when.get(m.pk)) for m in milestones)
    if ordered:
        _require_order(reached)
    implied = False if fails and not success else _implied_success(reached)
    if implied is None and success is None:
        raise EvaError(_SUCCESS_MISSING_NO_MILESTONE_THIS)
    if implied is not None and success is not None and success != implied:
        raise EvaError(_SUCCESS_CONTRADICTS_REQUIRED_MILESTONES_WHICH(success=success, implied=implied))
    final = bool(success if implied is None else implied)
    return ScoredOutcome(reached, _share(reached, final), final)


def reached_in_truth(truth: Mapping[str, Any], milestone: Milestone) -> bool | None:
    """Return whether the ground truth reports the milestone as reached in time; None if it does not report on it."""
    reached = truth.get("milestones", {}).get(milestone.truth)
    at, limit = truth.get("reached", {}).get(milestone.truth), milestone.time_limit_s
    late = at is not None and limit is not None and at > limit
    return None if reached is None else bool(reached) and not late


def truth_ticks(
    milestones: Sequence[Milestone], truth: Mapping[str, Any], *, ordered: bool
) -> tuple[dict[int, bool], dict[int, float]]:
    """Return by id which milestones count by the bench's ground truth, and when these were reached [s].

    Too late does not count, nor, if `ordered`, before an earlier milestone.

    Raises:
        EvaError: If the bench does not report on a milestone.
    """
    counts: dict[int, bool] = {}
    times: dict[int, float] = {}
    missed, last = False, 0.0
    for milestone in milestones:
        reached = reached_in_truth(truth, milestone)
        if reached is None:
            reports = ", ".join(truth.get("milestones", {})) or "no milestone"
            raise EvaError(_TRUTH_SILENT(text=milestone.text, name=milestone.truth, reports=reports))
        at = truth.get("reached", {}).get(milestone.truth)
        early = at is not None and at < last
        counts[milestone.pk] = reached and not (ordered and (missed or early))
        missed |= not counts[milestone.pk]
        if counts[milestone.pk] and at is not None:
            times[milestone.pk] = last = at
    return counts, times


def _answers(milestones: Sequence[Milestone], ticks: Mapping[object, object]) -> dict[int, bool]:
    texts = {milestone.pk: milestone.text for milestone in milestones}
    names = ", ".join(f"{pk} ({text})" for pk, text in texts.items()) or "none, the scene has no milestones"
    by_name = {str(pk): pk for pk in texts}
    answers: dict[int, bool] = {}
    for key, value in ticks.items():
        pk = by_name.get(str(key))
        if pk is None:
            raise EvaError(_MILESTONE_NOT_ONE_THIS_SCENE(key=key, names=names))
        if not isinstance(value, bool):
            raise EvaError(_MILESTONE_ALLOWED_TRUE_FALSE(key=key, value=value))
        answers[pk] = value
    missing = [str(pk) for pk in texts if pk not in answers]
    if missing:
        raise EvaError(_MILESTONE_NOT_ANSWERED_SAY_TRUE(missing=", ".join(missing), names=names))
    return answers


def _times(
    milestones: Sequence[Milestone], answers: Mapping[int, bool], times: Mapping[object, object]
) -> dict[int, float]:
    by_key = {str(milestone.pk): milestone for milestone in milestones}
    seconds: dict[int, float] = {}
    for key, at in times.items():
        milestone = by_key.get(str(key))
        if milestone is None:
            raise EvaError(_TIMES_MILESTONE_NOT_ONE_THIS(key=key, known=", ".join(by_key)))
        if at is None:
            continue
        if isinstance(at, bool) or not isinstance(at, int | float) or not 0 <= at < LONGEST_RUN_S:
            raise EvaError(_TIMES_MILESTONE_ALLOWED_SECONDS_FROM(key=key, at=at))
        if not answers[milestone.pk]:
            raise EvaError(_TIMES_HAS_TIME_S_BUT(text=milestone.text, at=at))
        limit = milestone.time_limit_s
        if limit is not None and at > limit:
            raise EvaError(_REACHED_AFTER_S_COUNTS_WITHIN(text=milestone.text, at=at, limit=limit))
        seconds[milestone.pk] = float(at)
    return seconds


def _require_order(reached: Sequence[tuple[Milestone, bool, float | None]]) -> None:
    missed, last = "", 0.0
    for milestone, is_reached, at in reached:
        if is_reached and missed:
            raise EvaError(_TICKED_BEFORE_NOT_MILESTONES_THIS(text=milestone.text, missed=missed))
        if is_reached and at is not None and at < last:
            raise EvaError(_REACHED_AFTER_S_BEFORE_ONE(text=milestone.text, at=at))
        missed, last = missed or ("" if is_reached else milestone.text), at if at is not None else last


def _implied_success(reached: Sequence[tuple[Milestone, bool, float | None]]) -> bool | None:
    required = [is_reached for milestone, is_reached, _ in reached if milestone.required]
    return all(required) if required else None


def _share(reached: Sequence[tuple[Milestone, bool, float | None]], success: bool) -> float:
    total = sum(milestone.points for milestone, _, _ in reached)
    if not total:
        return float(success)
    return sum(milestone.points for milestone, is_reached, _ in reached if is_reached) / total
