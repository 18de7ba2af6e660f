"""Automatic judges: permission, requests, and recording of their judgements.

Judgements are never scores or ratings. Each version of a judge judges a trial once, whatever the result: repeating
until there is an answer would select answers. If a worker ends before the answer, nothing is recorded and the trial is
shown again.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterator, Sequence

from django.contrib.auth.models import User
from django.db import transaction
from django.db.models import Exists, OuterRef
from django.utils import timezone

from evaweb.accounts.roles import Role, require_role
from evaweb.core.errors import (
    Conflict,
    EvaError,
    NotAllowed,
    NotFound,
)
from evaweb.jobs.models import Job
from evaweb.jobs.services import enqueue
from evaweb.plans.models import Handout, Plan, PlanEvent, PlanState
from evaweb.results.judges.base import MilestoneJudgement, MilestonePrompt, NoVerdict, TrialCase
from evaweb.results.judges.loading import UsableJudge, build_judge
from evaweb.results.models import AutomaticJudge, Judgement
from evaweb.results.ratings.footage import is_watchable, trial_stills
from evaweb.results.ratings.record import RATINGS, JudgementLine
from evaweb.trials.models import Milestone, Trial, TrialStatus
from evaweb.trials.record import journal_uuid
from evaweb.trials.scoring import reached_in_truth
from evaweb.trials.services import run_checks
from runtime.core.sentences import Pattern
from runtime.recording.files import RecordingError

log = logging.getLogger(__name__)
_JUDGE_HAS_NO_ADDRESS_THERE = Pattern(
    "results.ratings.automatic.judge_has_no_address_there",
    "judge {judge} has no address: there is nothing to allow",
)
_OWNER_ADMINISTRATOR_ASKS_JUDGE = Pattern(
    "results.ratings.automatic.owner_administrator_asks_judge",
    "{plan} is {user}'s: its owner or an administrator asks a judge",
)
_DRAFT_HAS_NO_TRIALS_JUDGED = Pattern(
    "results.ratings.automatic.draft_has_no_trials_judged",
    "{plan} is a draft: it has no trials to be judged",
)
_THERE_NO_JUDGE_THERE = Pattern(
    "results.ratings.automatic.there_no_judge_there",
    "there is no judge {name!r:.80}; there are: {there}",
)
_JUDGE_ADDRESS_NOT_ALLOWED_ADMINISTRATOR = Pattern(
    "results.ratings.automatic.judge_address_not_allowed_administrator",
    "judge {judge}: its address is not allowed: an administrator allows it under Administration, Judges",
)

KIND = "judge"  # kind of the job
LONGEST_REASON, LONGEST_MODEL = 300, 200  # [characters] of a server's reason and model name


# --- administrators ----------------------------------------------------------------------------------------


def judge_allow(*, user: User, judge: AutomaticJudge) -> None:
    """Allow images to be sent to the judge's current address; the administrator is recorded."""
    require_role(user, Role.ADMIN)
    if not judge.address:
        raise Conflict(_JUDGE_HAS_NO_ADDRESS_THERE(judge=judge))
    build_judge(judge.name, judge.kind, judge.setup)
    judge.allowed_address, judge.allowed_by, judge.allowed_at = judge.address, user, timezone.now()
    judge.save(update_fields=["allowed_address", "allowed_by", "allowed_at"])
    log.info("judge %s: %a allows %s", judge, user.get_username(), judge.address)


def judge_forbid(*, user: User, judge: AutomaticJudge) -> None:
    """Withdraw the permission: nothing more is sent. A request in progress is still completed."""
    require_role(user, Role.ADMIN)
    judge.allowed_address, judge.allowed_by, judge.allowed_at = "", None, None
    judge.save(update_fields=["allowed_address", "allowed_by", "allowed_at"])
    log.info("judge %s: %a allows it no longer", judge, user.get_username())


# --- requests ----------------------------------------------------------------------------------------------


def judges_ready() -> list[AutomaticJudge]:
    """Return the judges that could be used now."""
    judges = []
    for judge in AutomaticJudge.objects.all():
        try:
            _ready(judge)
        except EvaError:
            continue
        judges.append(judge)
    return judges


def request_judging(*, user: User, plan: Plan, name: str) -> Job:
    """Enqueue a job that shows all scored trials of the plan to the judge called `name`.

    Only the plan's owner and administrators may request this. They may do so before the reveal too, because judgements
    are hidden until then.
    """
    role = require_role(user, Role.OPERATOR)
    if role is not Role.ADMIN and plan.owner_id != user.pk:
        raise NotAllowed(_OWNER_ADMINISTRATOR_ASKS_JUDGE(plan=plan, user=plan.owner.get_username()))
    if plan.state == PlanState.DRAFT:
        raise Conflict(_DRAFT_HAS_NO_TRIALS_JUDGED(plan=plan))
    judge = _judge(name)
    _ready(judge)
    with transaction.atomic():
        PlanEvent.objects.create(
            plan=plan, by=user, what="judge asked", text=f"the judge {judge} ({judge.kind})"
        )
        return enqueue_judging(plan=plan, judge=judge.name)


def enqueue_judging(*, plan: Plan, judge: str) -> Job:
    """Enqueue the job that shows the plan's trials to a judge, unless there is one already."""
    return enqueue(kind=KIND, key=f"{KIND}:{plan.pk}:{judge}", args={"plan": plan.pk, "judge": judge})


def _judge(name: str) -> AutomaticJudge:
    judge = AutomaticJudge.objects.filter(name=name).first()
    if judge is None:
        names = ", ".join(AutomaticJudge.objects.values_list("name", flat=True))
        raise NotFound(_THERE_NO_JUDGE_THERE(name=name, there=names or "none, an administrator adds them"))
    return judge


def _ready(judge: AutomaticJudge) -> UsableJudge:
    """Return the judge ready for use.

    Raises:
        EvaError: If its set-up is invalid, or its address is not allowed.
    """
    usable = build_judge(judge.name, judge.kind, judge.setup)
    if usable.served and judge.allowed_address != judge.address:
        raise NotAllowed(_JUDGE_ADDRESS_NOT_ALLOWED_ADMINISTRATOR(judge=judge))
    return usable


# --- judging -----------------------------------------------------------------------------------------------


def judge_next_trial(*, plan: Plan, name: str) -> bool:
    """Show the next trial to the judge and record its judgement; return False if no trial can be shown.

    No database lock is held while the judge works.

    Raises:
        EvaError: If the judge itself fails; nothing is recorded.
    """
    judge = _ready(_judge(name))  # checked again for each trial: the permission may have been withdrawn
    handout = next(_showable(plan, judge), None)
    if handout is None:
        return False
    run_checks("judged", handout.trial, None)
    judgement = Judgement(trial=handout.trial, judge=judge.name, version=judge.version)
    milestones = list(handout.trial.scene.milestones.order_by("order"))
    verdicts = [MilestoneJudgement()] * len(milestones)
    try:
        case = _case(handout.trial, milestones, judge)
        prompt = judge.prompt_text(case)
        judgement.prompt = hashlib.sha256(prompt.encode()).hexdigest() if prompt else ""
        judgement.pictures = [
            [still.camera, still.at, hashlib.sha256(still.jpeg).hexdigest()] for still in case.stills
        ]
        if judge.pictures and not case.stills:
            raise NoVerdict("there is no picture of it")
        verdict = judge.judge_case(case)
        judgement.model, verdicts = _short(verdict.model, LONGEST_MODEL), list(verdict.milestones)
    except RecordingError:
        log.warning("judge %s: pictures of trial %s cannot be read", name, handout.trial_id, exc_info=True)
        judgement.reason = "its pictures cannot be read"
    except NoVerdict as none:
        judgement.reason = _short(str(none), LONGEST_REASON) or "it gave none"
    judgement.milestones = [
        [row.text, milestone_verdict.reached, milestone_verdict.probability]
        for row, milestone_verdict in zip(milestones, verdicts, strict=True)
    ]
    _store_judgement(judgement)
    return True


def _short(text: str, longest: int) -> str:
    """Return a third party's text on one line, cut to at most `longest` characters.

    Characters that SQLite or PostgreSQL would not accept are removed or replaced.
    """
    return " ".join(text.replace("\x00", "").encode("utf-8", "replace").decode().split())[:longest]


def unjudged_trials(*, plan: Plan, name: str) -> tuple[int, list[str]]:
    """Return the number of scored trials not shown to the judge, and the codes of those without images on
    this machine.
    """
    judge = _ready(_judge(name))
    waiting = list(_waiting(plan, judge))
    return len(waiting), [row.code for row in waiting if not _has_evidence(row, judge)]


def _waiting(plan: Plan, judge: UsableJudge) -> Iterator[Handout]:
    """Yield the trials that count, have milestones and were not shown to the judge, in order of allocation."""
    judged = Judgement.objects.filter(trial=OuterRef("trial"), judge=judge.name, version=judge.version)
    rows = plan.handouts.filter(trial__status=TrialStatus.SCORED).exclude(Exists(judged))
    rows = rows.filter(Exists(Milestone.objects.filter(scene=OuterRef("trial__scene"))))
    yield from rows.select_related("trial__scene", "trial__episode").order_by("number")


def _showable(plan: Plan, judge: UsableJudge) -> Iterator[Handout]:
    return (handout for handout in _waiting(plan, judge) if _has_evidence(handout, judge))


def _has_evidence(handout: Handout, judge: UsableJudge) -> bool:
    return not judge.pictures or is_watchable(handout.trial.episode)


def _case(trial: Trial, milestones: Sequence[Milestone], judge: UsableJudge) -> TrialCase:
    """Return the information about a trial that the judge may have."""
    return TrialCase(
        trial.instruction,
        trial.scene.criterion,
        tuple(MilestonePrompt(row.text, row.time_limit_s) for row in milestones),
        trial_stills(trial.episode) if judge.pictures and trial.episode is not None else (),
        () if judge.pictures else tuple(reached_in_truth(trial.truth or {}, row) for row in milestones),
    )


@transaction.atomic
def _store_judgement(judgement: Judgement) -> None:
    """Write the judgement to the journal, then to the database, unless another worker was faster or the trial
    no longer counts.
    """
    trial = Trial.objects.select_for_update().get(pk=judgement.trial_id)
    named = {name: getattr(judgement, name) for name in ("trial_id", "judge", "version")}
    if trial.status != TrialStatus.SCORED or Judgement.objects.filter(**named).exists():
        return
    judgement.at = timezone.now()
    RATINGS.append(journal_uuid(trial), JudgementLine.written(judgement))
    judgement.save()
