"""Trials of a plan without people, at copies of a simulated station: a process per trial, several at the same time.

Trials are handed out, kept blind and scored as for an operator. A copy exists for one trial, in lockstep, so that the
result depends neither on the number of copies nor on what ran before. If this program is killed at any moment, its next
start carries on with the trials that were handed out, whose results are the same.
"""

from __future__ import annotations

import fcntl
import json
import os
import platform
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any
from uuid import uuid5

from django.conf import settings
from django.contrib.auth.models import User
from django.db import close_old_connections, connection

from evaweb.accounts.roles import Role, require_role
from evaweb.core.errors import Conflict, EvaError
from evaweb.core.lock_wait import retry_while_locked
from evaweb.episodes.folders import episodes_dir
from evaweb.jobs.models import Job, JobStatus
from evaweb.jobs.selectors import job_newest
from evaweb.jobs.services import cancel, enqueue
from evaweb.plans.allocation import allocate_trial, plan_progress
from evaweb.plans.counting import fails_by
from evaweb.plans.design import dropped_of, findings_of
from evaweb.plans.models import Plan, PlanState, StoppingRule
from evaweb.plans.selectors import without_dropped
from evaweb.plans.services import end_plan_if_decided
from evaweb.stations.models import Station
from evaweb.trials.models import Scene, Score, Trial, TrialStatus
from evaweb.trials.selectors import UNFINISHED
from evaweb.trials.services import dismiss_trial, score_trial
from evaweb.trials.station_commands import run_args, setup_args
from evaweb.trials.station_events import record_whole_run
from runtime.benches.schema import UnusableBench
from runtime.core.environment import without_web_secrets

FOLDER = "farm"  # below the data folder
JOB = "copies"
_MOST_ATTEMPTS = 3  # of one trial whose run is interrupted
_LOOK_S = 1.0  # longest wait until a copy looks again whether it is its trial's turn
_DISMISSED = "the plan's design had ended, or dropped its checkpoint, when it was its turn"
_NOTE = "scored from the bench's truth"
_WORDS = 2000  # characters of a process's last words in an error
Tell = Callable[[str], None]


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


class _NothingLeft(Exception):
    """The plan has no further trial for the station; the message says why."""


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


def carry_out(*, user: User, plan: Plan, station: Station, count: int, most: int | None, tell: Tell) -> int:
    """Carry out the next trials of a plan at `count` copies of a station, until none is left; return their number.

    Args:
        user: Operator of the trials, for whom a blind plan stays blind.
        plan: A frozen plan.
        station: A simulated station.
        count: Number of copies that run at the same time.
        most: Greatest number of trials; None: all.
        tell: Called with a line after each trial.

    Raises:
        EvaError: If a trial cannot be carried out. Trials that other copies have begun are finished first.
    """
    copies = _check(plan, station, count)
    with _alone(station), ThreadPoolExecutor(count, "copy") as pool:
        run = _Run(user, plan, station, copies, most, tell)
        work = [
            pool.submit(run.work, f"{platform.node()}:{os.getpid()}/{number}"[-60:])
            for number in range(count)
        ]
        try:
            return sum(done.result() for done in work)
        except BaseException:
            run.stop()
            raise


def _check(plan: Plan, station: Station, count: int) -> Copies:
    """Return how copies of the station are started. Raises: EvaError if the plan cannot be carried out at them."""
    copies = copies_of(station)
    if count < 1:
        raise EvaError(f"{count} copies; allowed: 1 or more")
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


def request_trials(*, user: User, plan: Plan, station: Station, count: int) -> Job:
    """Queue the job that carries out the plan's trials at `count` copies of a station, until none is left.

    Raises:
        EvaError: If a trial of the plan could not be carried out so.
    """
    require_role(user, Role.OPERATOR)
    _check(plan, station, count)
    if plan.state != PlanState.FROZEN:
        raise Conflict(f"{plan} is {plan.get_state_display()}: only trials of a running plan are carried out")
    if is_at_work(job_newest(key=_key(plan))):
        raise Conflict(f"trials of {plan} are carried out already: pause that first")
    args = {"plan": plan.pk, "station": station.pk, "user": user.pk, "count": count}
    return enqueue(kind=JOB, key=_key(plan), args=args)


def pause_trials(*, user: User, plan: Plan) -> Job:
    """Let no further trial begin; those at work are finished. Raises: Conflict if none is carried out."""
    require_role(user, Role.OPERATOR)
    job = job_newest(key=_key(plan))
    if job is None or not is_at_work(job):
        raise Conflict(f"no trial of {plan} is carried out at copies: there is nothing to pause")
    return cancel(user=user, job=job)


def job_of(plan: Plan) -> Job | None:
    """Return the newest job that carries out trials of the plan, None if there is none."""
    return job_newest(key=_key(plan))


def is_at_work(job: Job | None) -> bool:
    """Return True while trials are carried out, or are about to be."""
    return (
        job is not None
        and job.status in (JobStatus.QUEUED, JobStatus.RUNNING)
        and job.cancelled_by_id is None
    )


def stations_with_copies(plan: Plan) -> list[Station]:
    """Return the stations at whose copies trials of the plan can be carried out."""
    started = [file.stem for file in _folder().glob("*.json")]
    if not started:
        return []
    rows = Station.objects.filter(simulated=True, active=True, name__in=started)
    return list(rows.filter(pk__in=plan.stations.all()) if plan.stations.exists() else rows)


def carry_out_some(args: Mapping[str, Any], report: Tell) -> dict[str, int]:
    """Carry out two trials per copy, and queue the job again if more are left, so that other jobs get their turn."""
    plan, user = Plan.objects.get(pk=args["plan"]), User.objects.get(pk=args["user"])
    station, count = Station.objects.get(pk=args["station"]), int(args["count"])

    def on_line(line: str) -> None:
        progress = plan_progress(plan)
        report(f"trial {min(progress.counted + 1, progress.total)} of {progress.total}")

    on_line("")
    made = carry_out(user=user, plan=plan, station=station, count=count, most=2 * count, tell=on_line)
    left = trials_left(plan)
    if made and left:
        enqueue(kind=JOB, key=_key(plan), args=args)
    return {"made": made, "left": left}


def _key(plan: Plan) -> str:
    return f"{JOB}:{plan.pk}"


def trials_left(plan: Plan) -> int:
    """Return how many trials of a plan do not count yet; 0 if it has ended."""
    fresh, progress = Plan.objects.get(pk=plan.pk), plan_progress(plan)
    return progress.total - progress.counted if fresh.state == PlanState.FROZEN else 0


class _Run:
    """Trials of one plan at copies of one station, each copy in a thread.

    If the plan's design may end early, trials are scored in the order of the schedule, so that what counts does not
    depend on the number of copies: a copy whose trial has ended waits until all earlier ones are scored.
    """

    def __init__(
        self, user: User, plan: Plan, station: Station, copies: Copies, most: int | None, tell: Tell
    ) -> None:
        self._user, self._plan, self._station = user, plan, station
        self._copies, self._left, self._tell = copies, most, tell
        self._early = plan.stopping != StoppingRule.NONE or plan.drop_arms
        self._turn = threading.Condition()
        self._running = 0  # copies that may still score a trial for which others wait
        self._begun = _begun_before(plan, station)

    def stop(self) -> None:
        """Let no further trial begin."""
        with self._turn:
            self._left = 0
            self._turn.notify_all()

    def work(self, worker: str) -> int:
        """Carry out trials one after the other, and return their number."""
        count = 0
        with self._turn:
            self._running += 1
        try:
            while self._may_begin():
                try:
                    self._carry_out(worker)
                except _NothingLeft as why:
                    if not count:
                        self._tell(str(why))
                    break
                count += 1
        except BaseException:
            self.stop()
            raise
        finally:
            connection.close()
            with self._turn:
                self._running -= 1
                self._turn.notify_all()
        return count

    def _may_begin(self) -> bool:
        with self._turn:
            if self._left == 0:
                return False
            self._left = None if self._left is None else self._left - 1
            return True

    def _carry_out(self, worker: str) -> None:
        close_old_connections()
        started = time.monotonic()
        trial = self._next(worker)
        folder = _folder() / "trials" / str(trial.uuid)
        if trial.status == TrialStatus.PREPARED:
            result = _run_process(folder, trial, self._user, self._copies)
            trial = retry_while_locked(lambda: _record(trial, result))
        shutil.rmtree(folder, ignore_errors=True)
        self._settle(trial)
        trial.refresh_from_db()
        if trial.status == TrialStatus.INTERRUPTED and trial.attempt >= _MOST_ATTEMPTS:
            raise EvaError(f"trial {trial.pk} was interrupted {trial.attempt} times: {trial.reason}")
        self._tell(_line(self._plan, trial, time.monotonic() - started))

    def _next(self, worker: str) -> Trial:
        """Return a trial that was begun before this program was started, or the next of the plan."""
        with self._turn:
            if self._begun:
                return self._begun.pop(0)
        try:
            handout = retry_while_locked(
                lambda: allocate_trial(user=self._user, station=self._station, plan=self._plan, worker=worker)
            )
        except Conflict as conflict:
            others = Trial.objects.filter(handout__plan=self._plan, status__in=UNFINISHED).exists()
            if trials_left(self._plan) and not others:
                raise
            raise _NothingLeft(str(conflict)) from None
        return handout.trial

    def _settle(self, trial: Trial) -> None:
        """Score the trial, at once or in its turn."""
        if not self._early:
            if _is_to_be_scored(self._plan, trial):
                retry_while_locked(lambda: _score(trial, self._user))
            return
        with self._turn:
            self._settle_in_order()
            self._turn.notify_all()
            self._running -= 1
            try:
                while self._waits(trial):
                    self._turn.wait(_LOOK_S)
            finally:
                self._running += 1

    def _waits(self, trial: Trial) -> bool:
        """Return True while an earlier trial, which another copy runs, has to be scored first."""
        trial.refresh_from_db()
        return _is_to_be_scored(self._plan, trial) and self._running > 0

    def _settle_in_order(self) -> None:
        """Score the trials whose turn it is, and dismiss those that the design does not need any more."""
        while (trial := _first_unscored(self._plan)) is not None and _is_to_be_scored(self._plan, trial):
            retry_while_locked(partial(_score, trial, self._user))
            dropped = dropped_of(self._plan)
            result = findings_of(self._plan)
            for other in Trial.objects.filter(handout__plan=self._plan, verdict=None).exclude(worker=None):
                slot = other.handout.slot
                is_dropped = dropped.get(slot.checkpoint.name, slot.block + 1) <= slot.block
                if is_dropped or (result is not None and result.ended == "boundary"):
                    retry_while_locked(partial(dismiss_trial, trial=other, reason=_DISMISSED))
            if result is not None and result.ended == "boundary":
                retry_while_locked(partial(end_plan_if_decided, user=self._user, plan=self._plan, asked=True))
                return


def _begun_before(plan: Plan, station: Station) -> list[Trial]:
    """Return the trials at copies of the station that an earlier program has left unfinished, in order.

    Raises:
        EvaError: If one is of another plan.
    """
    rows = Trial.objects.filter(station=station, status__in=UNFINISHED).exclude(worker=None)
    rows = rows.select_related("handout__plan").order_by("handout__number")
    for trial in rows:
        if trial.handout.plan_id != plan.pk:
            raise EvaError(
                f"trial {trial.pk} at a copy of {station.name} is unfinished: carry out {trial.handout.plan} first"
            )
    return list(rows)


def _first_unscored(plan: Plan) -> Trial | None:
    """Return the newest attempt at the first slot of the schedule that does not count yet, None if it has none."""
    counted = plan.handouts.filter(trial__status=TrialStatus.SCORED).values("slot")
    slots = without_dropped(plan.slots.exclude(pk__in=counted), dropped_of(plan))
    slot = slots.order_by("index").first()
    handout = slot and slot.handouts.select_related("trial").order_by("-number").first()
    return handout.trial if handout else None


def _is_to_be_scored(plan: Plan, trial: Trial) -> bool:
    interrupted = trial.status == TrialStatus.INTERRUPTED and trial.verdict_id is None
    return trial.status == TrialStatus.ENDED or (interrupted and fails_by(plan, trial))


def _line(plan: Plan, trial: Trial, seconds: float) -> str:
    """Return a line about a trial, which reveals nothing of a blind plan."""
    progress = plan_progress(plan)
    outcome = str(TrialStatus(trial.status).label)
    if trial.verdict is not None:
        outcome = f"{'success' if trial.verdict.success else 'no success'}, {trial.verdict.score:.0%}"
    lasted = f"{trial.duration_s or 0.0:.1f} s in {seconds:.1f} s"
    return (
        f"{progress.counted:>4} of {progress.total}  {trial.handout.code}  position {trial.position.number}  "
        f"{outcome}, {lasted}"
    )


def _run_process(folder: Path, trial: Trial, user: User, copies: Copies) -> Mapping[str, Any]:
    """Run the trial in a process of its own, unless it has been run already, and return its result."""
    kept = folder / "result.json"
    if kept.exists():
        done: Mapping[str, Any] = json.loads(kept.read_bytes())
        return done
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
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
    command = [sys.executable, "-m", "runtime.standins.trial", copies.deployment, "--lifeline"]
    command += [*copies.options, *serving, *(part for assignment in sets for part in ("--set", assignment))]
    with (folder / "log").open("wb") as log:
        child = subprocess.Popen(
            command,
            cwd=settings.BASE_DIR,
            env=without_web_secrets(os.environ),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
        )
        assert child.stdin is not None
        assert child.stdout is not None
        try:
            child.stdin.write(json.dumps(orders).encode() + b"\n")
            child.stdin.flush()
            answer = child.stdout.read()
            code = child.wait()
        finally:
            child.stdin.close()
            child.stdout.close()
            child.wait()
    if code:
        words = (folder / "log").read_text("utf-8", "replace").strip()[-_WORDS:]
        raise EvaError(
            f"trial {trial.pk} at a copy of {trial.station.name} failed ({code}): {words.splitlines()[-1:]}"
        )
    new = kept.with_suffix(".new")
    new.write_bytes(answer)
    new.replace(kept)
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


def _record(trial: Trial, result: Mapping[str, Any]) -> Trial:
    """Move the trial's recording to those of the lab, and record the run."""
    made = Path(result["episode"].get("path") or "")
    if made.name and made.exists():
        episodes_dir().mkdir(parents=True, exist_ok=True)
        made.replace(episodes_dir() / made.name)
    return record_whole_run(
        trial=trial, events=result["events"], state=result["state"], reason=result["reason"]
    )


def _score(trial: Trial, user: User) -> None:
    """Score the trial by the bench's ground truth."""
    score_trial(
        user=user,
        trial=trial,
        milestones={},
        note=_NOTE,
        source=Score.Source.TRUTH,
        uuid=uuid5(trial.uuid, "truth"),  # a repetition after a kill is the same score
    )


@contextmanager
def _alone(station: Station) -> Iterator[None]:
    """Hold the copies of a station during the block. Raises: Conflict if another program holds them."""
    _folder().mkdir(parents=True, exist_ok=True)
    with (_folder() / f"{station.name}.lock").open("a+") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise Conflict(
                f"another program carries out trials at copies of {station.name}: end it first"
            ) from None
        yield


def _folder() -> Path:
    return Path(settings.DATA_DIR) / FOLDER


def _file_of(station: str) -> Path:
    return _folder() / f"{station}.json"
