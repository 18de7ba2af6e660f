"""Trials of a plan without people, at copies of a simulated station: a process per trial, several at the same time.

Trials are handed out, kept blind and scored as for an operator. A copy exists for one trial, in lockstep, so that the
result depends neither on the number of copies nor on what ran before. Each copy is a job, which carries out a trial and
is queued again; so copies can be at work on several machines. If a worker is killed at any moment, its trial is run
again, with the same result.
"""

from __future__ import annotations

import fcntl
import json
import os
import platform
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any
from uuid import uuid5

from django.conf import settings
from django.contrib.auth.models import User
from django.db import connection, transaction
from django.db.models import Max, Q, QuerySet

from evaweb.accounts.roles import Role, require_role, role_of
from evaweb.blinding.visibility import Visibility, visibility_for_user
from evaweb.core.errors import Conflict, EvaError
from evaweb.core.lock_wait import retry_while_locked
from evaweb.episodes.folders import episodes_dir
from evaweb.episodes.models import Episode
from evaweb.jobs.kinds import JobContext, JobUnfinished, Queue
from evaweb.jobs.models import Job, JobStatus
from evaweb.jobs.services import OWNER, cancel, enqueue, reclaim_stale_jobs, requeue, work_off
from evaweb.jobs.workers import has_lab_folder, served
from evaweb.plans.allocation import (
    BrokenAgain,
    NothingLeft,
    NotYet,
    allocate_trial,
    plan_progress,
    require_allowed,
)
from evaweb.plans.counting import ScoreFirst, fails_by
from evaweb.plans.covered_jobs import Cover, cover_of
from evaweb.plans.design import dropped_of, findings_of
from evaweb.plans.frozen_document import require_checkpoints, require_scene
from evaweb.plans.models import Handout, Plan, PlanState, StoppingRule
from evaweb.plans.selectors import without_dropped
from evaweb.plans.services import end_plan_if_decided, noted_end
from evaweb.plans.trial_processes import PROCESSES
from evaweb.stations.models import Station
from evaweb.trials import lifecycle
from evaweb.trials.models import Scene, Score, Trial, TrialStatus
from evaweb.trials.selectors import UNFINISHED
from evaweb.trials.services import dismiss_trial, register_check, score_trial
from evaweb.trials.station_commands import run_args, setup_args
from evaweb.trials.station_events import record_whole_run
from runtime.benches.schema import UnusableBench
from runtime.core.machine import machine_kind
from runtime.core.sentences import Pattern

_WAITS_FOR_ITS_TURN = Pattern(
    "plans.copies.waits_for_its_turn",
    "trial {trial} is scored by the bench's truth when it is its turn, by copies: it can be corrected then",
)

FOLDER = "farm"  # below the data folder
JOB = "copies"
MOST_COPIES = 256  # of one plan that a person may ask for
_LOOK_S = 1.0  # until a copy looks again whether others have scored the trials that come first
_AHEAD = 2  # trials per copy that may wait for the score of an earlier one
_POLL_S = 0.5
_LONGEST_S = 900.0  # for the start of a trial's process and its set-up, after which it counts as hanging
_SLOWEST = 30.0  # times the trial's time limit, for its run
_PACE = 20  # newest trials from which the pace is taken
_DISMISSED = "the plan's design had ended, or dropped its checkpoint, when it was its turn"
_NOTE = "scored from the bench's truth"
_settling: ContextVar[bool] = ContextVar(
    "settling", default=False
)  # whether this program scores a copy's trial
_MOVED = ".moved"  # ending of the name of a file that says which recording a run has moved
_WORDS = 2000  # characters of a process's last words in an error


@dataclass(frozen=True, slots=True)
class Copies:
    """How copies of a simulated station are started: as the lab has started the station itself.

    Attributes:
        deployment: Path of the deployment file.
        assignments: Assignments KEY=VALUE on top of it.
        options: Command-line options of the bench.
        servers: Policy servers that the lab has started, by address: `line`, the command line of
            runtime.standins.serve, and `delay_ms`, the latency of responses if the checkpoint declares none. A copy
            starts such a server for itself; all other servers are shared by all copies.
    """

    deployment: str
    assignments: Sequence[str]
    options: Sequence[str]
    servers: Mapping[str, Mapping[str, Any]]


def write_copies(station: str, copies: Copies) -> None:
    """Record how copies of a simulated station are started; called by the lab that starts the station."""
    file = _file_of(station)
    file.parent.mkdir(parents=True, exist_ok=True)
    new = file.with_suffix(".new")
    new.write_text(json.dumps(asdict(copies)), "utf-8")
    new.replace(file)


def copies_of(station: Station) -> Copies:
    """Return how copies of the station are started.

    Raises:
        EvaError: If the station has a real robot, or no lab of this data folder has started it.
    """
    if not station.simulated:
        raise EvaError(
            f"station {station.name} has a real robot, of which there are no copies; allowed: a simulated one"
        )
    try:
        return Copies(**json.loads(_file_of(station.name).read_bytes()))
    except FileNotFoundError:
        raise EvaError(
            f"it is not known how copies of {station.name} are started: no lab of {settings.DATA_DIR} has started it "
            "yet; start it under First steps, or by manage.py demo"
        ) from None
    except (OSError, ValueError, TypeError) as error:
        raise EvaError(
            f"{_file_of(station.name)}: {error}: start the lab anew, which writes it again"
        ) from None


def _check(plan: Plan, station: Station, count: int) -> Copies:
    """Return how copies of the station are started. Raises: EvaError if the plan cannot be carried out at them."""
    copies = copies_of(station)
    if not 1 <= count <= MOST_COPIES:
        raise EvaError(f"{count} copies; allowed: 1 to {MOST_COPIES}")
    _require_reports(plan)
    if plan.match_gate is not None:
        raise EvaError(
            f"{plan} wants a person to compare the bench with a reference picture (least match {plan.match_gate:g}); "
            "allowed: a plan without one"
        )
    return copies


def _require_reports(plan: Plan) -> None:
    """Raise EvaError unless the benches of its scenes report all milestones, and runs end by themselves."""
    for scene in Scene.objects.filter(positions__plan=plan).distinct():
        if scene.time_limit_s is None:
            raise EvaError(
                f"scene {scene.name} has no time limit, and nobody ends its runs; allowed: one with a limit"
            )
        try:
            reports = scene.schema.milestones
        except UnusableBench as error:
            raise EvaError(f"scene {scene.name}: {error}") from None
        for milestone in scene.milestones.all():
            if milestone.truth not in reports:
                raise EvaError(
                    f"milestone {milestone.text!r} of scene {scene.name} is {milestone.truth!r} in the bench's truth, "
                    f"and nobody scores it here; allowed: {', '.join(reports)}"
                )


# --- as jobs ---------------------------------------------------------------------------------------------------


def request_trials(
    *, user: User, plan: Plan, station: Station, count: int, most: int | None = None
) -> list[Job]:
    """Queue `count` jobs, each of which carries out trials of the plan at a copy of a station until none is left.

    `most` is the greatest number of trials that all of them begin; None: all.

    Raises:
        EvaError: If a trial of the plan could not be carried out so.
    """
    require_role(user, Role.OPERATOR)
    _check(plan, station, count)
    require_allowed(plan, user, station)
    if jobs_at_work(plan):
        raise Conflict(f"trials of {plan} are carried out already: pause that first")
    first = plan.handouts.aggregate(last=Max("number"))["last"] or 0
    args = {
        "plan": plan.pk,
        "station": station.pk,
        "user": user.pk,
        "count": count,
        "first": first,
        "most": most,
    }
    with transaction.atomic():
        return [
            enqueue(kind=JOB, key=f"{keys_of(plan)}{number}", args={**args, "copy": number})
            for number in range(1, count + 1)
        ]


def pause_trials(*, user: User, plan: Plan) -> None:
    """Let no further trial begin; those at work are finished. Raises: Conflict if none is carried out."""
    require_role(user, Role.OPERATOR)
    jobs = jobs_at_work(plan)
    if not jobs:
        raise Conflict(f"no trial of {plan} is carried out at copies: there is nothing to pause")
    for job in jobs:
        cancel(user=user, job=job)


def keys_of(plan: Plan) -> str:
    """Return how the keys of the jobs begin that carry out trials of the plan."""
    return f"{JOB}:{plan.pk}:"


def jobs_at_work(plan: Plan) -> list[Job]:
    """Return the jobs that carry out trials of the plan, or are about to."""
    active = _jobs(plan).filter(status__in=(JobStatus.QUEUED, JobStatus.RUNNING), cancelled_by=None)
    return list(active.order_by("pk"))


def job_ended_last(plan: Plan) -> Job | None:
    """Return the job of the last start that ended; None if there is none, or the last start was paused.

    Of several, it is one that failed or else stopped before no trial was left.
    """
    ended = _jobs(plan).filter(status__in=(JobStatus.DONE, JobStatus.FAILED)).order_by("-finished_at")
    last = ended.first()
    if last is None or last.cancelled_by_id is not None:
        return None
    together = ended.filter(args__first=last.args.get("first"), cancelled_by=None)
    return max(together, key=lambda job: (bool(job.error), "stopped" in job.result), default=last)


def _why_ended(job: Job) -> str:
    return job.error or str(job.result.get("stopped") or job.result.get("ended", ""))


def _jobs(plan: Plan) -> QuerySet[Job]:
    return Job.objects.filter(kind=JOB, key__startswith=keys_of(plan))


def stations_with_copies(plan: Plan) -> list[Station]:
    """Return the stations at whose copies trials of the plan can be carried out."""
    started = [file.stem for file in _folder().glob("*.json")]
    if not started:
        return []
    rows = Station.objects.filter(simulated=True, active=True, name__in=started)
    return list(rows.filter(pk__in=plan.stations.all()) if plan.stations.exists() else rows)


@dataclass(frozen=True, slots=True)
class CopiesState:
    """How trials of a plan are carried out at copies.

    Attributes:
        copies: Number of copies, and how many of them are `running`.
        lacks: Why no worker runs them, "" if some do.
        counted, total: Trials that count, and all.
        left_s: Time until all are scored [s], None if unknown.
        ended: Why the last copies ended before the plan, "" if they did not; `hidden` if it may name what is hidden
            from the user.
    """

    copies: int
    running: int
    lacks: str
    counted: int
    total: int
    left_s: float | None
    ended: str
    hidden: bool


def copies_state(plan: Plan, sight: Visibility) -> CopiesState:
    """Return how trials of the plan are carried out at copies, as the user may see it."""
    jobs, last, progress = jobs_at_work(plan), job_ended_last(plan), plan_progress(plan)
    why = ""
    if not jobs and last is not None and progress.counted < progress.total:
        why = _why_ended(last)
    hidden = last is not None and bool(why) and cover_of(last, sight) is not Cover.NOTHING
    return CopiesState(
        copies=len(jobs),
        running=sum(job.status == JobStatus.RUNNING for job in jobs),
        lacks=next(filter(None, map(served().lacks, jobs)), "") if jobs else "",
        counted=progress.counted,
        total=progress.total,
        left_s=time_left_s(plan),
        ended="" if hidden else why,
        hidden=hidden,
    )


def trials_left(plan: Plan) -> int:
    """Return how many trials of a plan do not count yet; 0 if it has ended."""
    fresh, progress = Plan.objects.get(pk=plan.pk), plan_progress(plan)
    return progress.total - progress.counted if fresh.state == PlanState.FROZEN else 0


def time_left_s(plan: Plan) -> float | None:
    """Return the time until all trials of the plan are scored, at the pace of the newest ones [s]; None: unknown."""
    jobs = jobs_at_work(plan)
    if not jobs:
        return None
    since = min(job.created_at for job in jobs)
    newest = _at_copies(plan).filter(verdict__scored_at__gte=since).order_by("-verdict__pk")[:_PACE]
    times = [(trial.prepared_at, trial.verdict.scored_at) for trial in newest if trial.verdict]
    if not times:
        return None
    took = max(scored for _, scored in times) - max(since, min(prepared for prepared, _ in times))
    return took.total_seconds() / len(times) * trials_left(plan)


def lines_of_settled(plan: Plan, known: set[int]) -> Iterator[str]:
    """Yield a line about each trial at a copy that is settled and not `known`, to which it is added.

    The lines reveal nothing of a blind plan.
    """
    for trial in _at_copies(plan).exclude(pk__in=known).order_by("handout__number"):
        if trial.status in lifecycle.OPEN_STATES or is_to_be_scored(plan, trial):
            continue
        known.add(trial.pk)
        yield _line(plan, trial)


def _line(plan: Plan, trial: Trial) -> str:
    progress = plan_progress(plan)
    outcome = str(TrialStatus(trial.status).label)
    if trial.verdict is not None:
        outcome = f"{'success' if trial.verdict.success else 'no success'}, {trial.verdict.score:.0%}"
    return (
        f"{progress.counted:>4} of {progress.total}  {trial.handout.code}  position {trial.position.number}  "
        f"{outcome}, {trial.duration_s or 0.0:.1f} s"
    )


def carry_out(
    *, user: User, plan: Plan, station: Station, count: int, most: int | None, tell: Callable[[str], None]
) -> None:
    """Carry out trials of the plan in this program, and in the workers of the lab if there are any, until none is left.

    `tell` is called with a line about each trial. The other arguments are those of `request_trials`.

    Raises:
        EvaError: If a trial cannot be carried out.
    """
    if not has_lab_folder():
        raise EvaError(
            f"{settings.DATA_DIR} is not the lab's data folder; allowed: the one that the web uses"
        )
    reclaim_stale_jobs()
    if Queue.COPIES not in served().queues:
        for job in jobs_at_work(plan):
            if job.status == JobStatus.QUEUED:  # of a program that was killed
                cancel(user=user, job=job)
    known = set(_at_copies(plan).exclude(status__in=UNFINISHED).values_list("pk", flat=True))
    jobs = request_trials(user=user, plan=plan, station=station, count=count, most=most)
    for _ in jobs:
        threading.Thread(target=_work_off, args=(plan,), daemon=True).start()
    told: set[tuple[int, str]] = set()
    try:
        while active := jobs_at_work(plan):
            lines = [_error_of(job, user) for job in active if job.error and (job.pk, job.error) not in told]
            told |= {(job.pk, job.error) for job in active}
            for line in (*lines, *lines_of_settled(plan, known)):
                tell(line)
            time.sleep(_POLL_S)
    except BaseException:
        with suppress(Conflict):  # the last one has just ended
            pause_trials(user=user, plan=plan)
        requeue(owner=OWNER)
        raise
    for line in lines_of_settled(plan, known):
        tell(line)
    last = job_ended_last(plan)
    if last is not None and last.error:
        raise EvaError(_error_of(last, user))
    if last is not None and trials_left(plan):
        tell(_why_ended(last))


def _error_of(job: Job, user: User) -> str:
    hidden = cover_of(job, visibility_for_user(user)) is not Cover.NOTHING
    return (
        "a trial failed, and the reason may name what is hidden from you: ask the plan's owner"
        if hidden
        else job.error
    )


def _work_off(plan: Plan) -> None:
    try:
        while jobs_at_work(plan):
            if not work_off(Queue.COPIES, keys_of(plan)):
                time.sleep(_POLL_S)
    finally:
        connection.close()


# --- one trial after the other -----------------------------------------------------------------------------------


def carry_out_next(work: JobContext) -> Mapping[str, Any]:
    """Carry out the next trial of a plan at a copy of a station.

    Returns:
        `ended`, why no trial is left, or `stopped`, why this copy carries out no further one.

    Raises:
        JobUnfinished: The next trial is still to be carried out.
        EvaError: A trial cannot be carried out; it is run again at the next start.
    """
    args = work.args
    plan = Plan.objects.select_related("evaluation", "owner").get(pk=args["plan"])
    user, station = User.objects.get(pk=args["user"]), Station.objects.get(pk=args["station"])
    progress = plan_progress(plan)
    work.report_progress(f"trial {min(progress.counted + 1, progress.total)}/{progress.total}")
    copies = _check(plan, station, args["count"])
    settle_trials(plan, user)
    trial = _begun_before(plan, station, args["copy"])
    if trial is None:
        if _is_far_ahead(plan, station, args["count"]):
            raise JobUnfinished(_LOOK_S)
        try:
            trial = _next(plan, station, user, args)
        except NothingLeft as nothing:
            _discard_leftovers()
            return {"ended": str(nothing)}
        except BrokenAgain as why:
            return {"stopped": str(why)}
        except (ScoreFirst, NotYet) as first:
            if first.trial is None or first.trial.worker:
                raise JobUnfinished(_LOOK_S) from None
            return {"stopped": str(first)}
    require_scene(plan, trial.scene)
    require_checkpoints(plan)
    run_trial(trial, user, copies)
    settle_trials(plan, user)
    raise JobUnfinished


def _next(plan: Plan, station: Station, user: User, args: Mapping[str, Any]) -> Trial:
    worker = _worker(plan, args["copy"])
    handout = retry_while_locked(
        lambda: allocate_trial(
            user=user, station=station, plan=plan, worker=worker, first=args["first"], most=args["most"]
        )
    )
    return handout.trial


def _worker(plan: Plan, number: int) -> str:
    return f"{plan.pk}.{number} {platform.node()[:30]} {machine_kind()}"


def _begun_before(plan: Plan, station: Station, number: int) -> Trial | None:
    """Return a trial that was handed out to this copy, or to one that is not at work any more, and has not been run."""
    rows = _at_copies(plan).filter(station=station, status=TrialStatus.PREPARED).order_by("handout__number")
    mine = rows.filter(worker__startswith=f"{plan.pk}.{number} ").first()
    if mine is not None:
        return mine
    active = _jobs(plan).filter(status__in=(JobStatus.QUEUED, JobStatus.RUNNING))
    others = [f"{plan.pk}.{args['copy']} " for args in active.values_list("args", flat=True)]
    for trial in rows:
        if not str(trial.worker).startswith(tuple(others)):
            orphan = Trial.objects.filter(pk=trial.pk, status=TrialStatus.PREPARED, worker=trial.worker)
            if retry_while_locked(partial(orphan.update, worker=_worker(plan, number))):
                return trial
    return None


def _is_far_ahead(plan: Plan, station: Station, count: int) -> bool:
    """Return True while many trials wait for the score of an earlier one, which another copy runs."""
    first = _first_unscored(plan, station.pk) if ends_early(plan) else None
    if first is None or first.status not in lifecycle.OPEN_STATES:
        return False
    rows = _at_copies(plan).filter(station=station, verdict=None)
    return sum(is_to_be_scored(plan, trial) for trial in rows) >= _AHEAD * count


# --- scores ------------------------------------------------------------------------------------------------------


def ends_early(plan: Plan) -> bool:
    """Return True if the plan's design may end, or drop a checkpoint, before all trials are made."""
    return bool(plan.stopping != StoppingRule.NONE or plan.drop_arms)


def settle_trials(plan: Plan, user: User) -> None:
    """Score the trials at copies that have ended, by the bench's truth.

    If the plan's design may end early, those of each station are scored in the order of the schedule, so that what
    counts does not depend on the number of copies, and trials that the design does not need are dismissed. Any number
    of programs may do so at the same time: each decides on a trial after all that come before it count.
    """
    waiting = [trial for trial in _at_copies(plan).filter(verdict=None) if is_to_be_scored(plan, trial)]
    if not ends_early(plan):
        for trial in waiting:
            _score(trial, user)
        return
    stations = {trial.handout.slot.station_id for trial in waiting}
    for station in stations:
        while True:
            first = _first_unscored(
                plan, station
            )  # before the findings, which so have all that comes before it
            if _has_ended(plan, user) or first is None or not is_to_be_scored(plan, first):
                break
            _score(first, user)
    if not stations:
        _has_ended(plan, user)


def _has_ended(plan: Plan, user: User) -> bool:
    """Dismiss the trials at copies that the design does not need, and return True if it has ended."""
    dropped, result = dropped_of(plan), findings_of(plan)
    ended = bool(noted_end(plan)) or (result is not None and result.ended == "boundary")
    counted = plan.handouts.filter(trial__status=TrialStatus.SCORED).values("slot")
    unscored = (TrialStatus.PREPARED, TrialStatus.ENDED, TrialStatus.INTERRUPTED)
    for trial in (
        _at_copies(plan).filter(verdict=None, status__in=unscored).exclude(handout__slot__in=counted)
    ):
        slot = trial.handout.slot
        if ended or dropped.get(slot.checkpoint.name, slot.block + 1) <= slot.block:
            retry_while_locked(partial(dismiss_trial, trial=trial, reason=_DISMISSED))
    if ended:
        retry_while_locked(partial(end_plan_if_decided, user=user, plan=plan, asked=True))
    return ended


def _first_unscored(plan: Plan, station: int | None) -> Trial | None:
    """Return the newest attempt at the station's first slot of the schedule that does not count; None before any.

    Slots that people run are left out: they do not wait for copies, nor copies for them.
    """
    counted = plan.handouts.filter(trial__status=TrialStatus.SCORED).values("slot")
    slots = without_dropped(plan.slots.filter(station_id=station).exclude(pk__in=counted), dropped_of(plan))
    for slot in slots.order_by("index"):
        handout = slot.handouts.select_related("trial").order_by("-number").first()
        trial = handout.trial if handout else None
        if trial is None or trial.status in lifecycle.REPEATABLE_STATES or _is_of_copies(plan, trial):
            return trial
    return None


def _is_of_copies(plan: Plan, trial: Trial) -> bool:
    """Return True if copies run the trial, or will score it; a trial without a truth waits for a person."""
    return bool(trial.worker) and (trial.status in lifecycle.OPEN_STATES or is_to_be_scored(plan, trial))


def is_to_be_scored(plan: Plan, trial: Trial) -> bool:
    """Return True if the trial was run at a copy, and has no score though the plan counts it and the bench knows it."""
    if not trial.worker or trial.verdict_id is not None or trial.truth is None:
        return False
    interrupted = trial.status == TrialStatus.INTERRUPTED
    return trial.status == TrialStatus.ENDED or (interrupted and fails_by(plan, trial))


def _at_copies(plan: Plan) -> QuerySet[Trial]:
    rows = Trial.objects.filter(~Q(worker=None), handout__plan=plan)
    return rows.select_related(
        "handout__slot__checkpoint", "verdict", "episode", "scene", "position", "station"
    )


def _score(trial: Trial, user: User) -> None:
    """Score the trial by the bench's ground truth, unless a person has scored it meanwhile.

    The rater is its operator or, if that person is no operator any more, `user`.
    """
    rater = user if role_of(trial.operator) is Role.VIEWER else trial.operator

    def score() -> None:
        try:
            score_trial(
                user=rater,
                trial=trial,
                milestones={},
                note=_NOTE,
                source=Score.Source.TRUTH,
                uuid=uuid5(trial.uuid, "truth"),  # a repetition is the same score
            )
        except Conflict:
            trial.refresh_from_db()
            if is_to_be_scored(trial.handout.plan, trial):
                raise

    settling = _settling.set(True)
    try:
        retry_while_locked(score)
    finally:
        _settling.reset(settling)


def _require_turn(action: str, trial: Trial, user: Any) -> None:
    """Raise Conflict if a person scores a trial of a copy that waits for its turn."""
    if action != "scored" or _settling.get() or not trial.worker:
        return
    handout = Handout.objects.select_related("plan").filter(trial=trial).first()
    if handout is not None and handout.plan.state == PlanState.FROZEN and ends_early(handout.plan):
        trial = _at_copies(handout.plan).get(pk=trial.pk)
        if is_to_be_scored(handout.plan, trial):
            raise Conflict(_WAITS_FOR_ITS_TURN(trial=trial.pk))


register_check(_require_turn)


# --- the process of a trial ---------------------------------------------------------------------------------------


def run_trial(trial: Trial, user: User, copies: Copies) -> Trial:
    """Run the trial in a process of its own, and record the run."""
    own = _folder() / "trials" / str(trial.uuid)
    with _alone(own):
        _discard_moved(own)
        folder = Path(tempfile.mkdtemp(dir=own))
        result = _run_process(folder, trial, user, copies)
        trial.refresh_from_db()
        if trial.status == TrialStatus.PREPARED:
            _move_recording(trial, result, own)
            trial = retry_while_locked(
                lambda: record_whole_run(
                    trial=trial, events=result["events"], state=result["state"], reason=result["reason"]
                )
            )
        _discard_moved(own)
        shutil.rmtree(own, ignore_errors=True)
    return trial


@contextmanager
def _alone(own: Path) -> Iterator[None]:
    """Hold the folder of a trial during the block. Raises: JobUnfinished if another copy on this disk has it."""
    own.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(own, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise JobUnfinished(_LOOK_S) from None
        yield
    finally:
        os.close(descriptor)


def _move_recording(trial: Trial, result: Mapping[str, Any], own: Path) -> None:
    """Move the recording of a trial to those of the lab; a file of the trial's own folder says which.

    Raises:
        EvaError: The recording is not there, or not whole.
    """
    made = Path((result["episode"] or {}).get("path") or "")
    if not made.name:
        return  # none was opened
    waits = any(
        event["kind"] == "episode_closed" and event["data"].get("waits") for event in result["events"]
    )
    if waits or not made.exists():
        raise EvaError(
            f"trial {trial.pk}: its recording {made.name} "
            + ("waits for room on the disk: make some" if waits else "is not there any more")
        )
    (own / f"{made.name}{_MOVED}").touch()
    episodes_dir().mkdir(parents=True, exist_ok=True)
    arriving = episodes_dir() / f".{made.name}"
    shutil.move(
        made, arriving
    )  # may be another file system: a copy, which has no final name before it is whole
    arriving.replace(episodes_dir() / made.name)


def _discard_moved(own: Path) -> None:
    """Remove the recordings that a run of the trial has moved to those of the lab, and that no row names."""
    for file in own.glob(f"*{_MOVED}"):
        name = file.name.removesuffix(_MOVED)
        if not Episode.objects.filter(uuid=name).exists():
            for path in (episodes_dir() / f".{name}", episodes_dir() / name):
                shutil.rmtree(path, ignore_errors=True)


def _discard_leftovers() -> None:
    """Remove the folders of trials that will not be run again, such as those that a person has abandoned."""
    folders = list(
        (_folder() / "trials").glob("*")
    )  # before the query: a trial has its row before its folder
    begun = Trial.objects.filter(~Q(worker=None), status=TrialStatus.PREPARED).values_list("uuid", flat=True)
    needed = set(map(str, begun))
    for own in folders:
        if own.name not in needed:
            with suppress(JobUnfinished), _alone(own):
                _discard_moved(own)
                shutil.rmtree(own, ignore_errors=True)


def _run_process(folder: Path, trial: Trial, user: User, copies: Copies) -> Mapping[str, Any]:
    """Run the trial in a process of its own, which works in `folder`, and return its result.

    Raises:
        EvaError: The process failed.
    """
    orders = _orders(trial, user)
    policy = orders["setup"]["policy"]
    serving: list[str] = []
    if served := copies.servers.get(str(policy.get("url"))):
        orders["setup"]["policy"] = {"delay_ms": served["delay_ms"], **policy}
        serving = ["--serve", f"{served['line']} --port 0 --seed {trial.seed}"]
    sets = [
        *copies.assignments,
        f"data_dir={json.dumps(str(folder))}",
        f"station={json.dumps(trial.station.name)}",
    ]
    arguments = [copies.deployment, "--lifeline", *copies.options, *serving]
    arguments += [part for assignment in sets for part in ("--set", assignment)]
    process = PROCESSES.start(arguments, folder / "log", {"EVA_DATA_DIR": str(settings.DATA_DIR)})
    try:
        with suppress(BrokenPipeError):  # it has failed already
            process.input.write(json.dumps(orders).encode() + b"\n")
            process.input.flush()
        overdue = threading.Timer(_LONGEST_S + _SLOWEST * (trial.time_limit_s or 0.0), process.kill)
        overdue.daemon = True
        overdue.start()
        answer, code = process.output.read(), process.wait()
        overdue.cancel()
    finally:
        process.close()
    if code:
        words = (folder / "log").read_text("utf-8", "replace").strip()[-_WORDS:]
        raise EvaError(
            f"trial {trial.pk} at a copy of {trial.station.name} failed ({code}): {words.splitlines()[-1:]}"
        )
    result: Mapping[str, Any] = json.loads(answer)
    return result


def _orders(trial: Trial, user: User) -> dict[str, dict[str, Any]]:
    """Return the arguments of set-up and run, without least durations of set-up stages: nobody waits for them here."""
    setup = setup_args(trial, trial.uuid)
    setup.pop("least", None)
    orders: dict[str, dict[str, Any]] = json.loads(
        json.dumps({"setup": setup, "run": run_args(trial, user)}, default=str)
    )
    return orders


def _folder() -> Path:
    return Path(settings.DATA_DIR) / FOLDER


def _file_of(station: str) -> Path:
    return _folder() / f"{station}.json"
