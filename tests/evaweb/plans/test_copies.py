"""Trials at copies of a simulated station: handed out once, carried on after a kill, alike for any number of copies."""

from __future__ import annotations

import threading
import time
from uuid import uuid4

import pytest

from evaweb.core.errors import Conflict, EvaError
from evaweb.jobs.kinds import JobContext, kind_named
from evaweb.jobs.models import Job
from evaweb.plans import copies as farm
from evaweb.plans.allocation import plan_progress
from evaweb.plans.design import findings_of
from evaweb.plans.models import Plan
from evaweb.plans.services import freeze_plan
from evaweb.results.analysis.conduct import all_attempts
from evaweb.results.analysis.integrity import checkpoint_changes
from evaweb.trials.models import Checkpoint, Trial
from tests.evaweb.trials import builders

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
    """Stands where each trial's own process stands; `fault` is called with the number of a trial, from 1."""

    def __init__(self, monkeypatch, fault=lambda number: None):
        self.made, self.fault, self._lock = [], fault, threading.Lock()
        monkeypatch.setattr(farm, "_run_process", self)

    def __call__(self, folder, trial, user, copies):
        with self._lock:
            self.made.append(trial.pk)
            number = len(self.made)
        return self.fault(number) or result(trial)


def carry_out(bench, plan, count, most=None):
    lines = []
    made = farm.carry_out(
        user=bench.operator, plan=plan, station=bench.station, count=count, most=most, tell=lines.append
    )
    return made, lines


@pytest.mark.parametrize("count", [1, 3])
def test_every_trial_is_made_once_and_scored_by_the_truth(bench, monkeypatch, count):
    plan, processes = plan_of(bench), Processes(monkeypatch)
    made, lines = carry_out(bench, plan, count)
    trials = list(Trial.objects.select_related("verdict", "checkpoint", "handout"))
    assert made == len(trials) == len(set(processes.made)) == plan.slots.count() == 8
    assert {trial.handout.slot_id for trial in trials} == set(plan.slots.values_list("pk", flat=True))
    for trial in trials:
        assert (trial.status, trial.attempt, trial.verdict.source) == ("scored", 1, "truth")
        assert trial.verdict.success == (trial.checkpoint.name == WINS)
        assert (trial.duration_s, trial.episode.status, trial.station) == (10.0, "finished", bench.station)
        assert trial.worker
    assert farm.trials_left(plan) == 0
    assert not any(name in line for line in lines for name in (WINS, bench.checkpoint.name)), "blind"


@pytest.mark.parametrize("count", [1, 4])
def test_an_early_end_is_found_at_the_same_trial_for_any_number_of_copies(bench, monkeypatch, count):
    plan = plan_of(bench, repetitions=15, stopping="evidence", look_after=[])
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
    assert len(others) < count
    assert plan_progress(plan).attempts == len(all_attempts(plan, ())) == len(scored)
    assert sum(row.attempts for row in checkpoint_changes(plan)) == len(scored)


def test_what_was_begun_is_carried_on_after_a_kill(bench, monkeypatch):
    plan = plan_of(bench)

    class Killed(BaseException):
        pass

    def kill(number):
        if number >= 3:
            raise Killed

    processes = Processes(monkeypatch, kill)
    with pytest.raises(Killed):
        carry_out(bench, plan, 2)
    begun = set(Trial.objects.filter(status="prepared").values_list("pk", flat=True))
    assert begun
    processes.fault = lambda number: None
    carry_out(bench, plan, 1)
    assert begun <= set(processes.made[len(begun) :])
    assert set(Trial.objects.values_list("status", "attempt")) == {("scored", 1)}
    assert Trial.objects.count() == plan.slots.count()


def test_an_interrupted_run_is_repeated_and_not_for_ever(bench, monkeypatch):
    plan = plan_of(bench)
    processes = Processes(monkeypatch)
    broken = []

    def interrupt(number):
        trial = Trial.objects.get(pk=processes.made[number - 1])
        if number == 1 or broken:
            return result(trial, "holding")
        return None

    processes.fault = interrupt
    carry_out(bench, plan, 1, most=2)
    assert sorted(Trial.objects.values_list("status", "attempt")) == [("interrupted", 1), ("scored", 2)]
    broken.append(True)
    with pytest.raises(EvaError, match="was interrupted 3 times: time over"):
        carry_out(bench, plan, 1)


def test_a_person_is_not_disturbed_and_does_not_disturb(bench, monkeypatch):
    plan = plan_of(bench)
    by_hand = bench.prepare()  # at the station itself
    Processes(monkeypatch)
    carry_out(bench, plan, 1, most=1)
    by_hand.refresh_from_db()
    assert (by_hand.status, by_hand.worker) == ("prepared", None)
    bench.event("state", "a -> b: restarted", state="idle")
    assert set(Trial.objects.exclude(pk=by_hand.pk).values_list("status", flat=True)) == {"scored"}


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


def test_two_programs_do_not_share_the_copies_of_a_station(bench, monkeypatch):
    plan = plan_of(bench)

    def meanwhile(number):
        with pytest.raises(Conflict, match="another program carries out trials at copies of bench-1"):
            carry_out(bench, plan, 1)

    Processes(monkeypatch, meanwhile)
    carry_out(bench, plan, 1, most=1)


# --- as a job, from the plan's page ---------------------------------------------------------------------------


def page(client, plan):
    return client.get(f"/result/plans/{plan.name}/{plan.version}/").content.decode()


def press(client, plan, what, **fields):
    return client.post(
        f"/result/plans/{plan.name}/{plan.version}/{what}", fields, follow=True
    ).content.decode()


def worked_off():
    """Do what a worker does, until nothing waits."""
    reports = []
    while (job := Job.objects.filter(status="queued").order_by("pk").first()) is not None:
        job.status = "running"
        job.save()
        kind_named(job.kind)(JobContext(job.args, reports.append))
        Job.objects.filter(pk=job.pk).update(status="done")
    return reports


def test_an_operator_starts_and_pauses_it_on_the_page_of_the_plan(bench, client, monkeypatch):
    plan = plan_of(bench)
    Processes(monkeypatch)
    client.force_login(bench.operator)
    assert "Carry out the trials" in page(client, plan)
    assert "Pause: begin no further trial" in press(client, plan, "carry-out", station="bench-1", count="2")
    assert "are carried out already: pause that first" in press(
        client, plan, "carry-out", station="bench-1", count="2"
    )
    assert "Carry out the trials" in press(client, plan, "pause")
    assert not Trial.objects.exists()
    press(client, plan, "carry-out", station="bench-1", count="2")
    reports = worked_off()
    assert Job.objects.filter(kind="copies", status="done").count() == 2, "two trials per copy and job"
    assert set(Trial.objects.values_list("status", "operator__username")) == {("scored", "ann")}
    assert farm.trials_left(plan) == 0
    assert reports[0] == "trial 1 of 8"
    assert not any(name in report for report in reports for name in (WINS, bench.checkpoint.name))


@pytest.mark.parametrize(
    ("fields", "why"),
    [
        ({"station": "bench-1", "count": "0"}, "copies = &#x27;0&#x27;; allowed: 1 to 64"),
        ({"station": "bench-1", "count": "65"}, "allowed: 1 to 64"),
        ({"station": "bench-1", "count": "many"}, "allowed: 1 to 64"),
        ({"station": "bench-9", "count": "1"}, "bench-9"),
    ],
)
def test_what_cannot_be_started_is_said_on_the_page(bench, client, fields, why):
    plan = plan_of(bench)
    client.force_login(bench.operator)
    assert why in press(client, plan, "carry-out", **fields)
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
