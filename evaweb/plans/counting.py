"""Counting of runs that ended prematurely, as the plan declared before its first trial."""

from __future__ import annotations

from typing import Any

from evaweb.core.errors import Conflict
from evaweb.episodes.manifest import CLOSED
from evaweb.episodes.models import EpisodeStatus
from evaweb.plans.models import CountsAs, Handout, Plan
from evaweb.trials.endings import ENDINGS, ending_of
from evaweb.trials.models import Trial, TrialStatus
from evaweb.trials.services import declare_failing, register_check
from runtime.core.sentences import Pattern

_REPEATED = Pattern(
    "plans.counting.repeated",
    "trial {trial} was ended by {what}: by {plan} it is repeated, and not scored",
)
_FAILURE = Pattern(
    "plans.counting.failure",
    "trial {trial} was ended by {what}: by {plan} that is a failure, whatever was reached",
)
_A_FAILURE = Pattern(
    "plans.counting.a_failure", "Ended by {what}: a failure by the plan, whatever was reached"
)
_SCORE_IT_FIRST = Pattern(
    "plans.counting.score_it_first",
    "trial {trial} was ended by {what}: by {plan} that is a failure; score it before the next one",
)


ENDS = {f"on_{name}": words for name, words in ENDINGS.items()}


class ScoreFirst(Conflict):
    """Error if the previous attempt at a slot, `trial`, has to be scored before the next one."""

    def __init__(self, trial: Trial, plan: Plan) -> None:
        super().__init__(_SCORE_IT_FIRST(trial=trial.pk, what=ENDS[ended_by(trial)], plan=plan))
        self.trial = trial


def ended_by(trial: Trial) -> str:
    """Return the key of `ENDS` for what ended the trial's run.

    "" if the run ended by itself or the operator stopped it.
    """
    end = end_of(trial.ended_by, trial.status, trial.reason, trial.episode and trial.episode.status)
    return f"on_{end}" if end else ""


def end_of(kept: str | None, status: str, reason: str, recording: str | None) -> str:
    """Return the cause that ended a run: one of `ENDINGS`, or "" for none of these.

    That is the stored value `kept`. For trials that predate this value (`kept` is None), the cause is derived from
    `status` and `reason` of the trial and from the status `recording` of its recording (None without a recording).
    """
    if kept is not None:
        return kept
    broken = recording in (EpisodeStatus.INTERRUPTED, EpisodeStatus.FAILED)
    return ending_of(status == TrialStatus.INTERRUPTED or broken, reason)


def require_scored_first(plan: Plan, before: Trial | None) -> None:
    """Raise ScoreFirst if the previous attempt counts as a failure by the plan and is not scored yet."""
    if before is None or before.status != TrialStatus.INTERRUPTED:
        return
    if fails_by(plan, before):
        raise ScoreFirst(before, plan)


def fails_by(plan: Plan, trial: Trial) -> bool:
    """Return True if the plan counts the trial as a failure, whatever its score.

    A trial is never counted as a failure if nothing of its run was recorded, because it could not be scored.
    """
    counts = getattr(plan, ended_by(trial) or "on_nothing", CountsAs.JUDGED)
    episode = trial.episode
    nothing = episode is None or (episode.status in CLOSED and not episode.frames)
    return counts == CountsAs.FAILURE and not nothing


def declared_failures(plan: Plan) -> dict[int, str]:
    """Return the scored trials that count as failures by the plan's rules, because of how their runs ended.

    The dict maps the id of each of these trials to the text of what ended its run.
    """
    if all(getattr(plan, name) != CountsAs.FAILURE for name in ENDS):
        return {}
    rows = Trial.objects.filter(handout__plan=plan, status=TrialStatus.SCORED, episode__frames__gt=0)
    ends = ("ended_by", "status", "reason", "episode__status")
    ended = {trial: end_of(*end) for trial, *end in rows.values_list("pk", *ends)}
    return {
        trial: ENDINGS[by]
        for trial, by in ended.items()
        if getattr(plan, f"on_{by}", CountsAs.JUDGED) == CountsAs.FAILURE
    }


def _judged(action: str, trial: Trial, user: Any) -> None:
    if action not in ("voided", "judged success", "judged failure"):
        return
    handout = Handout.objects.select_related("plan").filter(trial=trial).first()
    end = ended_by(trial)
    if handout is None or not end:
        return
    counts = getattr(handout.plan, end)
    if action == "voided":  # a single operator could void an unscored failure to have it repeated
        if trial.verdict_id is None and fails_by(handout.plan, trial):
            raise ScoreFirst(trial, handout.plan)
        return
    if counts == CountsAs.REPEATED:
        raise Conflict(_REPEATED(trial=trial.pk, what=ENDS[end], plan=handout.plan))
    if counts == CountsAs.FAILURE and action == "judged success":
        raise Conflict(_FAILURE(trial=trial.pk, what=ENDS[end], plan=handout.plan))


def _failing(trial: Trial) -> str:
    handout = Handout.objects.select_related("plan").filter(trial=trial).first()
    if handout is None or not fails_by(handout.plan, trial):
        return ""
    return str(_A_FAILURE(what=ENDS[ended_by(trial)]))


register_check(_judged)
declare_failing(_failing)
