"""Trials at copies of a simulated station: handed out once, carried on after a kill, alike for any number of copies."""

from __future__ import annotations

import os
import subprocess
import threading
import time
from datetime import timedelta
from uuid import uuid4

import pytest
from django.db import connection
from django.db.models.functions import Now

from evaweb.core.errors import Conflict, EvaError
from evaweb.jobs.kinds import JobContext, JobUnfinished
from evaweb.jobs.models import Job
from evaweb.jobs.services import OWNER, claim, requeue, retry_job, work_off
from evaweb.plans import copies as farm
from evaweb.plans.allocation import allocate_trial, plan_progress, release_slots
from evaweb.plans.design import ENDED_EVENT, dropped_of, findings_of
from evaweb.plans.models import Handout, Plan
from evaweb.plans.services import freeze_plan
from evaweb.plans.trial_processes import TrialProcess
from evaweb.results.analysis.conduct import all_attempts
from evaweb.results.analysis.integrity import checkpoint_changes
from evaweb.results.presentation.integrity import integrity_document
from evaweb.results.presentation.setting import setting_now
from evaweb.stations.models import Station
from evaweb.trials.models import Checkpoint, Trial
from evaweb.trials.services import abandon_trial, create_trial, dismiss_trial, score_trial
from evaweb.trials.station_commands import trial_command
from evaweb.trials.voids import void_trial
from tests.evaweb.trials import builders
from tests.processes import PATIENCE_S, eventually

pytestmark = pytest.mark.django_db(transaction=True)
TRUTHS = ("grasped", "lifted", "placed")
WINS = "pi0-new"


@pytest.fixture(autouse=True)
def _data_dir(settings, tmp_path):
    settings.DATA_DIR = tmp_path


@pytest.fixture
def bench(transactional_db):
    made = builders.bench()
    for milestone, name in zip(made.scene.milestones.all(), TRUTHS, strict=True):
        milestone.truth = name
        milestone.save()
    farm.write_copies(made.station.name, farm.Copies("tabletop.toml", [], [], {}))
    return made


def plan_of(bench, repetitions=2, **fields):
    plan = Plan.objects.create(
        name="blocks", title="Blocks", owner=builders.user("olga"), repetitions=repetitions, **fields
    )
    other = Checkpoint.objects.create(name=WINS, policy={"url": "ws://127.0.0.1:8001"})
    plan.checkpoints.set([bench.checkpoint, other])
    plan.positions.set(bench.scene.positions.all())
    plan.first, plan.second = other, bench.checkpoint
    plan.save()
    return freeze_plan(user=plan.owner, plan=plan)


def result(trial, state="ready"):
    """What the process of a trial prints; the better checkpoint succeeds."""
    success, uuid, wall = trial.checkpoint.name == WINS, str(uuid4()), time.time()
    closed = {"uuid": uuid, "status": "finished", "reason": "time over", "rows": 300, "waits": False}
    truth = {"episode": uuid, "milestones": dict.fromkeys(TRUTHS, success), "success": success}
    facts = (("episode_opened", 1.0, {}), ("truth", 11.0, truth), ("episode_closed", 11.0, closed))
    events = [
        {"number": number, "kind": kind, "text": kind, "time": at, "wall": wall + at, "data": data}
        for number, (kind, at, data) in enumerate(facts, 1)
    ]
    return {"state": state, "reason": "time over", "episode": {"path": ""}, "events": events}


class Processes:
    """Stands where each trial's own process stands; `fault` is called with the trial, and may return its result."""

    def __init__(self, monkeypatch, fault=lambda trial: None):
        self.made, self.fault, self._lock = [], fault, threading.Lock()
        monkeypatch.setattr(farm, "_run_process", self)

    def __call__(self, folder, trial, user, copies):
        with self._lock:
            self.made.append(trial.pk)
        return self.fault(trial) or result(trial)


def carry_out(bench, plan, count, most=None):
    lines = []
    farm.carry_out(
        user=bench.operator, plan=plan, station=bench.station, count=count, most=most, tell=lines.append
    )
    return lines


def request(bench, plan, count=1, most=None):
    return farm.request_trials(user=bench.operator, plan=plan, station=bench.station, count=count, most=most)


def states():
    return list(Trial.objects.order_by("handout__number").values_list("status", "attempt"))


def stopped_by_estop(trial):
    """Result of a run that an e-stop has ended."""
    stopped = result(trial, "fault")
    stopped["reason"] = stopped["events"][2]["data"]["reason"] = "e-stop by ann"
    return stopped


EARLY = {"repetitions": 15, "stopping": "evidence", "look_after": []}


@pytest.mark.parametrize("count", [1, 3])
def test_every_trial_is_made_once_and_scored_by_the_truth(bench, monkeypatch, count):
    plan, processes = plan_of(bench), Processes(monkeypatch)
    lines = carry_out(bench, plan, count)
    trials = list(Trial.objects.select_related("verdict", "checkpoint", "handout"))
    assert len(trials) == len(processes.made) == len(set(processes.made)) == plan.slots.count() == 8
    assert {trial.handout.slot_id for trial in trials} == set(plan.slots.values_list("pk", flat=True))
    for trial in trials:
        assert (trial.status, trial.attempt, trial.verdict.source) == ("scored", 1, "truth")
        assert trial.verdict.success == (trial.checkpoint.name == WINS)
        assert (trial.duration_s, trial.episode.status, trial.station) == (10.0, "finished", bench.station)
        assert trial.ended_at - trial.started_at == timedelta(seconds=10), "of the virtual clock"
        assert trial.worker.startswith(f"{plan.pk}.")
    assert farm.trials_left(plan) == 0
    assert len(lines) == 8
    assert not any(name in line for line in lines for name in (WINS, bench.checkpoint.name)), "blind"


def test_machines_of_several_kinds_are_counted_and_said(bench, monkeypatch):
    plan = plan_of(bench)
    Processes(monkeypatch)
    carry_out(bench, plan, 1)
    document = integrity_document(plan)
    ((machine, trials),) = [(row["name"], sum(row["trials"])) for row in document["machines"]["rows"]]
    assert trials == 8
    assert not any("several kinds" in text for text in document["remarks"])
    Trial.objects.filter(handout__number__lt=4).update(worker=f"{plan.pk}.1 gpu-1 00000000")
    (text,) = [text for text in integrity_document(plan)["remarks"] if "several kinds" in text]
    assert text.endswith(f"gpu-1 00000000 3, {machine} 5")


def test_trials_in_benchmark_mode_are_counted_and_said(bench, monkeypatch):
    def in_benchmark_mode(trial):
        made = result(trial)
        made["events"][1]["data"]["benchmark"] = trial.handout.number < 4
        return made

    plan = plan_of(bench)
    Processes(monkeypatch, in_benchmark_mode)
    carry_out(bench, plan, 1)
    (text,) = [text for text in integrity_document(plan)["remarks"] if "benchmark mode" in text]
    assert text.endswith("ends with the first success: 3 of 8 trials")
    assert "(simulated) and agilex_piper (simulated, in benchmark mode)" in setting_now(plan)


@pytest.mark.parametrize("count", [1, 4])
def test_an_early_end_is_found_at_the_same_trial_for_any_number_of_copies(bench, monkeypatch, count):
    plan = plan_of(bench, **EARLY)
    Processes(monkeypatch)
    carry_out(bench, plan, count)
    plan.refresh_from_db()
    found = findings_of(plan)
    assert (plan.state, found.ended) == ("closed", "boundary")
    scored = list(
        Trial.objects.filter(status="scored")
        .order_by("handout__slot__index")
        .values_list("handout__slot__index", flat=True)
    )
    assert scored == list(range(2 * found.at)), "all trials up to the crossing, and none after it"
    others = Trial.objects.exclude(status="scored")
    assert {trial.status for trial in others} <= {"not_needed"}
    assert len(others) <= farm._AHEAD * count + count
    assert plan_progress(plan).attempts == len(all_attempts(plan, ())) == len(scored)
    assert sum(row.attempts for row in checkpoint_changes(plan)) == len(scored)


def test_a_late_trial_keeps_the_others_from_being_scored_and_from_running_far_ahead(bench, monkeypatch):
    plan, late = plan_of(bench, **EARLY), threading.Event()
    ahead = []

    def fault(trial):
        if trial.handout.slot.index == 0:
            assert late.wait(PATIENCE_S)
        return

    def watch():
        eventually(
            lambda: Trial.objects.filter(status="ended").count() >= 2 * farm._AHEAD and not beginning(),
            "the other copy waits",
        )
        ahead.append((Trial.objects.filter(status="scored").count(), Trial.objects.count()))
        connection.close()
        late.set()

    def beginning():
        return Trial.objects.filter(status="prepared").exclude(handout__slot__index=0).exists()

    Processes(monkeypatch, fault)
    watching = threading.Thread(target=watch)
    watching.start()
    carry_out(bench, plan, 2, most=8)
    watching.join()
    assert ahead == [(0, 2 * farm._AHEAD + 1)]
    assert set(states()) == {("scored", 1)}


def drop_plan(bench, blind):
    plan = Plan.objects.create(
        name="drops",
        title="Drops",
        owner=builders.user("olga"),
        drop_arms=True,
        comparing="control",
        blind=blind,
        **EARLY,
    )
    for name in (WINS, "mid"):
        Checkpoint.objects.create(name=name, policy={"url": f"ws://127.0.0.1:8001/{name}"})
    plan.checkpoints.set(Checkpoint.objects.all())
    plan.positions.set(bench.scene.positions.all())
    plan.first = Checkpoint.objects.get(name=WINS)
    plan.save()
    return freeze_plan(user=plan.owner, plan=plan)


class Killed(BaseException):
    pass


def die(*of, **facts):
    raise Killed


def begun_and_killed(bench, plan, count=1):
    """A worker claims a job and is killed; then its job is queued again, as another worker finds it."""
    request(bench, plan, count)
    job = claim(queue="copies", owner=OWNER)
    with pytest.raises(Killed):
        farm.carry_out_next(JobContext(job.args, lambda text: None))
    assert requeue(owner=OWNER) == 1


def test_what_was_begun_is_carried_on_after_a_kill(bench, monkeypatch):
    plan, processes = plan_of(bench), Processes(monkeypatch, die)
    begun_and_killed(bench, plan)
    assert states() == [("prepared", 1)]
    left = farm._folder() / "trials" / str(Trial.objects.get().uuid)
    assert left.is_dir()
    processes.fault = lambda trial: None
    work_off("copies")
    assert processes.made[0] == processes.made[1], "the trial that was begun comes first"
    assert states() == [("scored", 1)] * plan.slots.count()
    assert not left.exists()


def test_what_a_copy_has_begun_is_carried_on_by_another_if_that_one_is_not_at_work_any_more(
    bench, monkeypatch
):
    plan, processes = plan_of(bench), Processes(monkeypatch, die)
    begun_and_killed(bench, plan, 3)
    farm.pause_trials(user=bench.operator, plan=plan)
    Trial.objects.update(worker=f"{plan.pk}.3 elsewhere")
    processes.fault = lambda trial: None
    request(bench, plan)
    work_off("copies")
    assert processes.made[0] == processes.made[1]
    assert states() == [("scored", 1)] * plan.slots.count()


def test_fewer_copies_than_were_killed_carry_on_all_of_their_trials(bench, monkeypatch):
    plan, processes = plan_of(bench), Processes(monkeypatch, die)
    request(bench, plan, 3)
    for number in (3, 2, 1):  # handed out in this order
        job = Job.objects.get(args__copy=number)
        with pytest.raises(Killed):
            farm.carry_out_next(JobContext(job.args, lambda text: None))
    farm.pause_trials(user=bench.operator, plan=plan)
    processes.fault = lambda trial: None
    carry_out(bench, plan, 1)
    assert states() == [("scored", 1)] * plan.slots.count()


@pytest.mark.parametrize("fields", [{}, EARLY])
def test_a_kill_before_the_score_is_made_up_for(bench, monkeypatch, fields):
    """Also of a run that counts as a failure because an e-stop ended it."""
    plan = plan_of(bench, on_estop="failure", **fields)
    Processes(monkeypatch, stopped_by_estop)
    with monkeypatch.context() as patched:
        patched.setattr(farm, "_score", die)
        begun_and_killed(bench, plan)
    assert states() == [("interrupted", 1)]
    Processes(monkeypatch)
    carry_out(bench, plan, 2, most=3)
    assert states() == [("scored", 1)] * 4
    assert not Trial.objects.get(handout__number=1).verdict.success


def test_an_interrupted_run_is_repeated_and_not_for_ever(bench, monkeypatch):
    plan = plan_of(bench, blind=False)
    processes = Processes(monkeypatch)
    processes.fault = lambda trial: (
        result(trial, "holding") if trial.handout.slot.index == 0 and trial.attempt != 2 else None
    )
    carry_out(bench, plan, 1, most=1)
    carry_out(bench, plan, 1, most=1)
    assert states() == [("interrupted", 1), ("scored", 2)]
    void_trial(user=builders.user("bob"), trial=Trial.objects.get(status="scored"), reason="a lamp failed")
    lines = carry_out(bench, plan, 4)
    assert [state for state in states() if state[1] > 1] == [
        ("voided", 2),
        *(("interrupted", at) for at in (3, 4, 5)),
    ], "whatever the number of copies"
    assert "was interrupted 3 times in a row: time over" in lines[-1]


def test_what_was_interrupted_before_the_end_stays_an_attempt(bench, monkeypatch):
    plan = plan_of(bench, **EARLY)
    Processes(monkeypatch, lambda trial: result(trial, "holding") if trial.handout.number == 2 else None)
    carry_out(bench, plan, 2)
    plan.refresh_from_db()
    assert plan.state == "closed"
    assert Trial.objects.get(handout__number=2).status == "interrupted"


def test_a_checkpoint_that_was_switched_off_since_is_not_run(bench, monkeypatch):
    plan, processes = plan_of(bench), Processes(monkeypatch, die)
    begun_and_killed(bench, plan)
    Checkpoint.objects.filter(name=WINS).update(active=False)
    with pytest.raises(Conflict, match="is switched off"):
        farm.carry_out_next(JobContext(Job.objects.get().args, lambda text: None))
    assert len(processes.made) == 1


def test_a_recording_that_no_row_names_is_not_left_behind(bench, monkeypatch, tmp_path):
    plan = plan_of(bench)

    def recorded(trial, meanwhile):
        made = result(trial)
        path = tmp_path / "of the process" / made["events"][2]["data"]["uuid"]
        path.mkdir(parents=True)
        (path / "manifest.json").write_text("{}")
        made["episode"]["path"] = str(path)
        meanwhile(trial)
        return made

    Processes(monkeypatch, lambda trial: recorded(trial, lambda trial: None))
    with monkeypatch.context() as patched:
        patched.setattr(farm, "record_whole_run", die)  # killed between move and record
        begun_and_killed(bench, plan)
    assert len(list((tmp_path / "episodes").iterdir())) == 1
    Processes(
        monkeypatch,
        lambda trial: recorded(trial, lambda trial: abandon_trial(user=bench.operator, trial=trial)),
    )
    job = claim(queue="copies", owner=OWNER)
    with pytest.raises(JobUnfinished):
        farm.carry_out_next(JobContext(job.args, lambda text: None))
    assert states() == [("abandoned", 1)]
    assert not list((tmp_path / "episodes").iterdir())


@pytest.mark.parametrize("fields", [{}, EARLY])
def test_a_trial_of_which_the_bench_says_nothing_waits_for_a_person_and_stops_nothing(
    bench, monkeypatch, fields
):
    plan = plan_of(bench, **fields)

    def silent(trial):
        made = result(trial)
        if trial.handout.number == 2:
            del made["events"][1]
        return made

    Processes(monkeypatch, silent)
    carry_out(bench, plan, 2, most=5)
    assert [state for state, _ in states()] == ["scored", "ended", "scored", "scored", "scored"]
    milestones = {str(row.pk): True for row in bench.scene.milestones.all()}
    score_trial(user=bench.operator, trial=Trial.objects.get(status="ended"), milestones=milestones)


def test_one_operator_who_is_none_any_more_stops_nobody(bench, monkeypatch):
    plan = plan_of(bench)
    Processes(monkeypatch)
    with monkeypatch.context() as patched:
        patched.setattr(farm, "_score", die)
        begun_and_killed(bench, plan)
    farm.pause_trials(user=bench.operator, plan=plan)
    bench.operator.groups.clear()
    bob = builders.user("bob")
    farm.request_trials(user=bob, plan=plan, station=bench.station, count=1)
    work_off("copies")
    assert set(states()) == {("scored", 1)}
    assert set(Trial.objects.values_list("verdict__rater__username", flat=True)) == {"bob"}


@pytest.mark.parametrize("on_estop", ["failure", "repeated"])
def test_copies_of_another_station_take_over(bench, monkeypatch, on_estop):
    plan = plan_of(bench, on_estop=on_estop)
    other = Station.objects.create(name="bench-2", robot=bench.station.robot, simulated=True)
    farm.write_copies("bench-2", farm.Copies("tabletop.toml", [], [], {}))
    Processes(monkeypatch, stopped_by_estop)
    with monkeypatch.context() as patched:
        patched.setattr(farm, "settle_trials", die)
        request(bench, plan)
        job = claim(queue="copies", owner=OWNER)
        patched.setattr(farm, "settle_trials", lambda *of: None)
        with pytest.raises(JobUnfinished):
            farm.carry_out_next(JobContext(job.args, lambda text: None))
        assert requeue(owner=OWNER) == 1
    assert states() == [("interrupted", 1)]
    farm.pause_trials(user=bench.operator, plan=plan)
    Processes(monkeypatch)
    release_slots(user=bench.operator, plan=plan, station=bench.station, reason="broken")
    farm.request_trials(user=bench.operator, plan=plan, station=other, count=1)
    work_off("copies")
    assert farm.trials_left(plan) == 0


def test_a_process_that_hangs_is_ended(bench, monkeypatch):
    plan = plan_of(bench)
    monkeypatch.setattr(farm, "_LONGEST_S", 0.2)
    monkeypatch.setattr(farm, "_SLOWEST", 0.0)

    def hanging(arguments, log, variables):
        log.touch()
        child = subprocess.Popen(["sleep", "1000"], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        status, reported = os.pipe()
        os.write(reported, f"{child.pid}\n".encode())

        def report():
            os.write(reported, f"{child.wait()}\n".encode())
            os.close(reported)

        threading.Thread(target=report).start()
        return TrialProcess(status, os.dup(child.stdin.fileno()), os.dup(child.stdout.fileno()))

    monkeypatch.setattr(farm.PROCESSES, "start", hanging)
    request(bench, plan)
    job = claim(queue="copies", owner=OWNER)
    with pytest.raises(EvaError, match=r"failed \(-9\)"):
        farm.carry_out_next(JobContext(job.args, lambda text: None))
    assert states() == [("prepared", 1)]


def test_the_folder_of_a_trial_that_runs_is_never_swept(bench, monkeypatch):
    plan = plan_of(bench)
    folders = []

    def abandoned(trial):
        abandon_trial(user=bench.operator, trial=trial)
        farm._discard_leftovers()
        folders.append(list((farm._folder() / "trials").iterdir()))

    Processes(monkeypatch, abandoned)
    carry_out(bench, plan, 1, most=1)
    assert [len(left) for left in folders] == [1]
    assert not list((farm._folder() / "trials").iterdir())


def test_a_recorded_end_counts_whatever_is_corrected_later(bench, monkeypatch):
    plan = plan_of(bench, **EARLY)
    processes = Processes(monkeypatch, die)
    begun_and_killed(bench, plan)
    plan.events.create(by=plan.owner, what=ENDED_EVENT, text="a boundary of its design was crossed")
    processes.fault = lambda trial: None
    work_off("copies")
    assert states() == [("not_needed", 1)]
    plan.refresh_from_db()
    assert plan.state == "closed"


# --- beside people ---------------------------------------------------------------------------------------------


def test_a_person_is_not_disturbed_and_does_not_disturb(bench, monkeypatch):
    plan = plan_of(bench)
    by_hand = bench.prepare()  # at the station itself
    Processes(monkeypatch)
    carry_out(bench, plan, 1, most=1)
    by_hand.refresh_from_db()
    assert (by_hand.status, by_hand.worker) == ("prepared", None)
    bench.event("state", "a -> b: restarted", state="idle")
    assert set(Trial.objects.exclude(pk=by_hand.pk).values_list("status", flat=True)) == {"scored"}


@pytest.mark.parametrize("ended", [False, True])
def test_a_person_s_trial_of_the_plan_is_the_person_s(bench, monkeypatch, ended):
    plan = plan_of(bench, **EARLY)
    trial = allocate_trial(user=bench.operator, station=bench.station, plan=plan).trial
    if ended:
        builders.finished_trial(trial)
        Trial.objects.update(truth={"milestones": dict.fromkeys(TRUTHS, True), "success": True})
    Processes(monkeypatch)
    carry_out(bench, plan, 2, most=3)
    trial.refresh_from_db()
    assert (trial.status, trial.verdict) == ("ended" if ended else "prepared", None)
    assert [state for state, _ in states()[1:]] == ["scored"] * 3


def test_a_person_may_score_first(bench, monkeypatch):
    plan = plan_of(bench)
    Processes(monkeypatch)
    ours, by = farm.record_whole_run, builders.user("bob")

    def record(*, trial, **facts):
        done = ours(trial=trial, **facts)
        if trial.handout.number == 1:
            milestones = {str(row.pk): True for row in bench.scene.milestones.all()}
            score_trial(user=by, trial=Trial.objects.get(pk=trial.pk), milestones=milestones)
        return done

    monkeypatch.setattr(farm, "record_whole_run", record)
    carry_out(bench, plan, 1, most=2)
    raters = Trial.objects.order_by("pk").values_list("verdict__rater__username", flat=True)
    assert list(raters) == ["bob", "ann"]


def test_a_person_cannot_score_a_copy_s_trial_out_of_turn_nor_run_it(bench, monkeypatch):
    plan, said = plan_of(bench, **EARLY), []
    milestones = {str(row.pk): True for row in bench.scene.milestones.all()}

    def score(trial):
        if trial.handout.number == 2:
            Processes(monkeypatch)
            with pytest.raises(Conflict, match="is run at a copy of bench-1, not at the station itself"):
                trial_command(
                    trial=trial, kind="setup", user=bench.operator, page="p", epoch=1, boot="b", sequence=1
                )
            Trial.objects.filter(pk=trial.pk).update(
                status="ended", truth={"milestones": dict.fromkeys(TRUTHS, True), "success": True}
            )
            with pytest.raises(Conflict, match="is scored by the bench's truth when it is its turn"):
                score_trial(user=bench.operator, trial=Trial.objects.get(pk=trial.pk), milestones=milestones)
            Trial.objects.filter(pk=trial.pk).update(status="prepared", truth=None)
            said.append(True)

    Processes(monkeypatch, score)
    carry_out(bench, plan, 1, most=3)
    assert said
    assert set(states()) == {("scored", 1)}


def test_a_person_goes_on_while_a_failure_waits_for_its_turn(bench, monkeypatch):
    plan, late = plan_of(bench, on_estop="failure", **EARLY), threading.Event()
    handed = []

    def fault(trial):
        if trial.handout.slot.index == 0:
            assert late.wait(PATIENCE_S)
        return stopped_by_estop(trial) if trial.handout.slot.index == 1 else None

    def person():
        eventually(lambda: Trial.objects.filter(status="interrupted").exists(), "a failure waits")
        handed.append(allocate_trial(user=builders.user("bob"), station=bench.station, plan=plan))
        connection.close()
        late.set()

    Processes(monkeypatch, fault)
    beside = threading.Thread(target=person)
    beside.start()
    carry_out(bench, plan, 2, most=3)
    beside.join()
    assert handed[0].slot.index > 1


def test_a_blind_plan_that_may_drop_is_carried_out_block_by_block(bench, monkeypatch):
    plan, late = drop_plan(bench, blind=True), threading.Event()
    begun = []

    def fault(trial):
        if trial.handout.slot.index == 0:
            assert late.wait(PATIENCE_S)
        return

    def watch():
        eventually(
            lambda: Trial.objects.filter(status="ended").count() == 2, "the others of the block have ended"
        )
        eventually(
            lambda: Job.objects.filter(status="queued", not_before__gt=Now()).count() >= 1, "they wait"
        )
        begun.append(Trial.objects.count())
        connection.close()
        late.set()

    Processes(monkeypatch, fault)
    watching = threading.Thread(target=watch)
    watching.start()
    carry_out(bench, plan, 4, most=7)
    watching.join()
    assert begun == [3]
    assert set(states()) == {("scored", 1)}


@pytest.mark.parametrize("blind", [True, False])
def test_a_trial_that_is_voided_meanwhile_is_repeated(bench, monkeypatch, blind):
    plan, bob = plan_of(bench, blind=blind, **EARLY), builders.user("bob")

    def void(trial):
        if trial.handout.number == 3:
            void_trial(user=bob, trial=Trial.objects.get(handout__number=1), reason="the camera fell")

    Processes(monkeypatch, void)
    carry_out(bench, plan, 1, most=6)
    assert states()[0] == ("void_asked" if blind else "voided", 1)
    assert states()[3] == ("scored", 2)
    assert [state for state, _ in states()[4:]] == ["scored"] * 2


def test_a_trial_that_a_drop_made_needless_is_made_if_the_drop_is_undone(bench, monkeypatch):
    plan = drop_plan(bench, blind=False)

    def wins(trial):
        made = result(trial)
        if trial.checkpoint.name == "mid":
            made["events"][1]["data"].update(milestones=dict.fromkeys(TRUTHS, True), success=True)
        return made

    Processes(monkeypatch, wins)
    for _ in range(20):
        carry_out(bench, plan, 1, most=3)
        if dropped_of(plan):
            break
    ((name, block),) = dropped_of(plan).items()
    assert name == bench.checkpoint.name
    slot = plan.slots.get(block=block, checkpoint=bench.checkpoint)
    plan.slots.filter(block=block).update(station=bench.station)
    needless = create_trial(
        user=bench.operator,
        station=bench.station,
        evaluation=plan.evaluation,
        scene=slot.scene,
        position=slot.position,
        checkpoint=slot.checkpoint,
        number=slot.repetition,
        attempt=1,
        worker="another copy",
    )
    Handout.objects.create(plan=plan, number=99, slot=slot, trial=needless, code="XXXXX")
    dismiss_trial(trial=needless, reason="dropped")
    milestones = {str(row.pk): True for row in bench.scene.milestones.all()}
    for trial in Trial.objects.filter(status="scored", handout__slot__checkpoint=bench.checkpoint):
        score_trial(user=bench.operator, trial=trial, milestones=milestones, reason="the truth was wrong")
    assert not dropped_of(plan)
    carry_out(bench, plan, 1, most=6)
    assert slot.handouts.order_by("number").last().trial.status == "scored"


def test_two_plans_share_the_copies_of_a_station(bench, monkeypatch):
    plan, processes = plan_of(bench), Processes(monkeypatch, die)
    begun_and_killed(bench, plan)
    farm.pause_trials(user=bench.operator, plan=plan)
    other = Plan.objects.create(name="two", title="Two", owner=plan.owner, repetitions=1)
    other.checkpoints.set(plan.checkpoints.all())
    other.positions.set(bench.scene.positions.all())
    other = freeze_plan(user=plan.owner, plan=other)
    processes.fault = lambda trial: None
    carry_out(bench, other, 1)
    assert farm.trials_left(other) == 0
    assert Trial.objects.get(handout__plan=plan).status == "prepared"


def test_what_belongs_to_another_station_is_a_normal_end(bench, monkeypatch):
    plan = plan_of(bench, repetitions=1)
    Station.objects.create(name="bench-2", robot=bench.station.robot)
    plan.slots.update(station=Station.objects.get(name="bench-2"))
    Processes(monkeypatch)
    assert "4 trials are on bench-2" in carry_out(bench, plan, 2)[-1]


@pytest.mark.parametrize(
    ("spoil", "why"),
    [
        (
            lambda bench, plan: bench.scene.milestones.update(truth=""),
            "is '' in the bench's truth, and nobody scores it here",
        ),
        (lambda bench, plan: type(bench.scene).objects.update(time_limit_s=None), "has no time limit"),
        (lambda bench, plan: type(bench.station).objects.update(simulated=False), "has a real robot"),
    ],
)
def test_what_needs_a_person_is_refused_before_the_first_trial(bench, monkeypatch, spoil, why):
    plan, processes = plan_of(bench), Processes(monkeypatch)
    spoil(bench, plan)
    plan.refresh_from_db()
    bench.station.refresh_from_db()
    with pytest.raises(EvaError, match=why):
        carry_out(bench, plan, 1)
    assert processes.made == []
    assert not Trial.objects.exists()


def test_a_plan_whose_bench_a_person_has_to_compare_is_refused(bench, monkeypatch):
    plan, processes = plan_of(bench, match_gate=0.5), Processes(monkeypatch)
    with pytest.raises(EvaError, match="wants a person to compare"):
        carry_out(bench, plan, 1)
    assert processes.made == []


def test_copies_of_a_station_that_no_lab_has_started_are_unknown(bench, monkeypatch):
    plan = plan_of(bench)
    Processes(monkeypatch)
    farm._file_of(bench.station.name).unlink()
    with pytest.raises(EvaError, match="it is not known how copies of bench-1 are started"):
        carry_out(bench, plan, 1)


# --- as a job, from the plan's page ---------------------------------------------------------------------------


def page(client, plan):
    return client.get(f"/result/plans/{plan.name}/{plan.version}/").content.decode()


def press(client, plan, what, **fields):
    return client.post(
        f"/result/plans/{plan.name}/{plan.version}/{what}", fields, follow=True
    ).content.decode()


def test_an_operator_starts_and_pauses_it_on_the_page_of_the_plan(bench, client, monkeypatch):
    plan = plan_of(bench)
    Processes(monkeypatch)
    client.force_login(bench.operator)
    assert "Carry out the trials" in page(client, plan)
    begun = press(client, plan, "carry-out", station="bench-1", count="2")
    assert "Pause: begin no further trial" in begun
    assert "0 of 8 trials count; 0 of 2 copies at work" in begun
    assert "No worker is running" in begun
    assert "are carried out already: pause that first" in press(
        client, plan, "carry-out", station="bench-1", count="2"
    )
    assert "Carry out the trials" in press(client, plan, "pause")
    work_off("copies")
    assert not Trial.objects.exists()
    press(client, plan, "carry-out", station="bench-1", count="2")
    work_off("copies")
    assert Job.objects.filter(kind="copies", status="done").count() == 2, "one per copy"
    assert set(Trial.objects.values_list("status", "operator__username")) == {("scored", "ann")}
    assert farm.trials_left(plan) == 0
    assert "ended early" not in page(client, plan)


def test_a_program_starts_and_pauses_it_over_rest(bench, client, monkeypatch):
    plan = plan_of(bench)
    Processes(monkeypatch)
    client.force_login(bench.operator)
    address = f"/api/v1/plans/{plan.name}/copies"

    def ask(method, **body):
        answer = getattr(client, method)(address, body or None, content_type="application/json")
        return answer.status_code, answer.json()

    assert ask("post", station="bench-1", count=257)[0] == 422
    status, state = ask("post", station="bench-1", count=2)
    assert (status, state["copies"], state["counted"], state["total"]) == (202, 2, 0, 8)
    assert ask("post", station="bench-1", count=2)[0] == 409
    assert ask("delete")[1]["copies"] == 0
    ask("post", station="bench-1", count=2)
    work_off("copies")
    answer = client.get(address).json()
    assert (answer["copies"], answer["counted"], answer["ended"]) == (0, 8, "")
    client.force_login(builders.user("vera", "viewer"))
    assert ask("post", station="bench-1", count=2)[0] == 403


def test_a_pause_at_the_last_moment_counts(bench, client, monkeypatch):
    plan = plan_of(bench)

    ours = farm.settle_trials

    def settle(*of):
        ours(*of)
        if Trial.objects.filter(status="scored").exists():  # the last that a job does
            farm.pause_trials(user=bench.operator, plan=plan)

    Processes(monkeypatch)
    monkeypatch.setattr(farm, "settle_trials", settle)
    request(bench, plan)
    work_off("copies")
    assert states() == [("scored", 1)]
    assert farm.jobs_at_work(plan) == []


def test_a_failed_one_is_started_on_the_page_of_the_plan_alone(bench, client, monkeypatch):
    plan = plan_of(bench)
    (job,) = request(bench, plan)
    farm.pause_trials(user=bench.operator, plan=plan)
    client.force_login(bench.operator)
    assert "Retry" not in client.get("/jobs/?status=failed").content.decode()
    with pytest.raises(Conflict, match="start it anew on its plan's page"):
        retry_job(user=bench.operator, job=Job.objects.get(pk=job.pk))


def test_an_error_that_names_what_another_plan_hides_is_hidden(bench, client, monkeypatch):
    blind = plan_of(bench)
    plan = Plan.objects.create(name="two", title="Two", owner=blind.owner, repetitions=1, blind=False)
    plan.checkpoints.set(blind.checkpoints.all())
    plan.positions.set(bench.scene.positions.all())
    plan = freeze_plan(user=plan.owner, plan=plan)
    request(bench, plan)
    Job.objects.update(status="failed", error=f"no policy server of {WINS}", finished_at=Now())
    client.force_login(bench.operator)
    assert "would name what is hidden from you" in page(client, plan)
    assert WINS not in page(client, plan)


@pytest.mark.parametrize(
    ("fields", "why"),
    [
        ({"station": "bench-1", "count": "0"}, "copies = &#x27;0&#x27;; allowed: 1 to 256"),
        ({"station": "bench-1", "count": "257"}, "allowed: 1 to 256"),
        ({"station": "bench-1", "count": "0064000"}, "allowed: 1 to 256"),
        ({"station": "bench-1", "count": "many"}, "allowed: 1 to 256"),
        ({"station": "bench-9", "count": "1"}, "bench-9"),
    ],
)
def test_what_cannot_be_started_is_said_on_the_page(bench, client, fields, why):
    plan = plan_of(bench)
    client.force_login(bench.operator)
    assert why in press(client, plan, "carry-out", **fields)
    assert not Job.objects.exists()


def test_who_has_seen_results_starts_nothing(bench, client):
    plan = plan_of(bench)
    client.force_login(plan.owner)
    press(client, plan, "look")
    assert "you have seen results of Blocks v1" in press(
        client, plan, "carry-out", station="bench-1", count="1"
    )
    assert not Job.objects.exists()


def test_nobody_is_offered_what_is_not_theirs_or_not_there(bench, client):
    plan = plan_of(bench)
    client.force_login(builders.user("vera", "viewer"))
    assert "Carry out the trials" not in page(client, plan)
    press(client, plan, "carry-out", station="bench-1", count="1")
    assert not Job.objects.exists()
    farm._file_of(bench.station.name).unlink()
    client.force_login(bench.operator)
    assert "Carry out the trials" not in page(client, plan)
