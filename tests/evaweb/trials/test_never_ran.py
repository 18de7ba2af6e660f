"""A run whose recording could not be opened is none: its trial is as it was, whoever hears of what in which order."""

import shutil
from collections import namedtuple
from contextlib import contextmanager

import pytest

from evaweb.blinding.visibility import visibility_for_user
from evaweb.console.event_ingest import ingest_events
from evaweb.console.feed import History
from evaweb.core.errors import Conflict
from evaweb.episodes.models import Episode
from evaweb.jobs.models import Job
from evaweb.plans import bench_checks as looking
from evaweb.plans.allocation import allocate_trial, plan_progress
from evaweb.plans.models import Plan
from evaweb.plans.services import freeze_plan
from evaweb.stations.models import Command, Station
from evaweb.trials import services
from evaweb.trials.models import Checkpoint, Trial
from evaweb.trials.selectors import statistics
from evaweb.trials.station_commands import trial_command
from runtime.recording import episode as episode_module
from runtime.recording.files import require_room
from tests.evaweb.trials import builders
from tests.evaweb.trials.whole_lab import Direct, lab

__all__ = ["lab"]

pytestmark = pytest.mark.django_db
Usage = namedtuple("Usage", "total used free")
GIB = 1 << 30


class Disk:
    """Has so much room for whoever asks, and however often."""

    def __init__(self, monkeypatch):
        self.free = 10 * GIB
        self._monkeypatch = monkeypatch
        monkeypatch.setattr(shutil, "disk_usage", lambda folder: Usage(20 * GIB, 0, self.free))

    @contextmanager
    def filled_as_an_episode_is_opened(self):
        """Until then there is room, for the coordinator too; afterwards there is room again."""

        def full(folder, wanted):
            self.free = 100
            require_room(folder, wanted)

        with self._monkeypatch.context() as patched:
            patched.setattr(episode_module, "require_room", full)
            yield
        self.free = 10 * GIB


@pytest.fixture
def disk(monkeypatch):
    return Disk(monkeypatch)


@pytest.fixture
def bench(lab, disk):
    """The lab, whose station wants 1 GiB, and whose events go through the chronicle."""
    recording = lab.station.spec.deployment.recording
    object.__setattr__(recording, "min_free_bytes", GIB)  # frozen

    def listen():
        rows = tuple(lab.station.coordinator.events.since(0))
        station = Station.objects.get(pk=lab.bench.station.pk)
        ingest_events(station=station, history=History(lab.station.coordinator.boot, rows))

    lab.listen = listen
    return lab


def ready(bench, trial):
    bench.station.until(lambda: str(bench.station.state) in ("idle", "ready"), 30.0, "a state to set up from")
    bench.give(trial, "setup")
    bench.station.until(lambda: str(bench.station.state) == "ready", 60.0, "set-up")


def press_run(bench, trial):
    order = {"page": "p", "epoch": 1, "boot": bench.station.coordinator.boot, "sequence": 0}
    return trial_command(user=bench.bench.operator, trial=trial, kind="run", **order)


def goes_on(bench, trial):
    bench.station.go(5)
    bench.listen()
    trial.refresh_from_db()
    return trial


def fails_to_open(bench, disk, trial):
    """There is room when the run is asked for, and none when media begins to record."""
    with disk.filled_as_an_episode_is_opened():
        row = press_run(bench, trial)
        assert row.status == "accepted"
        goes_on(bench, trial)
    return row


def is_as_it_was(trial):
    assert (trial.status, trial.run, trial.episode, trial.duration_s) == ("prepared", None, None, None)
    assert (trial.started_at, trial.ended_at, trial.attempt) == (None, None, 1)
    assert not Episode.objects.exists()
    assert not Job.objects.filter(kind="publish").exists()
    assert [row.summary.success.n for row in statistics()] == []


def runs_and_counts(bench, trial):
    assert press_run(bench, trial).status == "accepted"
    assert goes_on(bench, trial).status == "running"
    bench.give(trial, "stop")
    assert goes_on(bench, trial).status == "ended"
    bench.score(trial, True, True, True)
    assert [row.summary.success.n for row in statistics()] == [1]
    assert (trial.number, trial.attempt) == (1, 1)


def test_without_room_the_run_is_refused_with_numbers_and_the_trial_stays_prepared(bench, disk):
    trial = bench.bench.prepare()
    ready(bench, trial)
    disk.free = GIB - 1
    row = press_run(bench, trial)
    assert row.status == "refused"
    episodes = bench.station.spec.deployment.episodes_dir
    assert (
        f"too little room to record in {episodes}: {GIB - 1} bytes free, at least {GIB} wanted" in row.reason
    )
    is_as_it_was(goes_on(bench, trial))
    disk.free = GIB
    runs_and_counts(bench, trial)


def test_a_recording_that_cannot_be_opened_gives_the_trial_back_and_it_is_run_without_another_set_up(
    bench, disk
):
    trial = bench.bench.prepare()
    ready(bench, trial)
    row = fails_to_open(bench, disk, trial)
    is_as_it_was(trial)
    assert trial.reason.startswith("too little room to record in ")
    assert "too little room" in Command.objects.get(pk=row.pk).unopened
    runs_and_counts(bench, trial)


def test_an_answer_that_is_heard_after_all_events_begins_nothing(bench, disk, monkeypatch):
    trial = bench.bench.prepare()
    ready(bench, trial)

    class Late(Direct):
        def request(self, command, **how):
            ack = super().request(command, **how)
            goes_on(bench, trial)  # all is over before the one who asked hears of it
            return ack

    monkeypatch.setattr("evaweb.stations.commands.connection_to", lambda name: Late(bench.station))
    row = fails_to_open(bench, disk, trial)
    is_as_it_was(trial)
    order = {"page": "p", "epoch": 1, "boot": bench.station.coordinator.boot, "sequence": 0}
    again = trial_command(user=bench.bench.operator, trial=trial, kind="run", uuid=row.pk, **order)
    assert again.status == "accepted"  # its first answer
    is_as_it_was(goes_on(bench, trial))


def test_events_that_come_again_after_the_trial_was_given_back_or_runs_anew_change_nothing(bench, disk):
    trial = bench.bench.prepare()
    ready(bench, trial)
    fails_to_open(bench, disk, trial)
    old = bench.station.coordinator.events.since(0)

    def again():
        for event in old:
            services.apply_station_event(
                station=bench.bench.station, event=event, boot=bench.station.coordinator.boot
            )
        trial.refresh_from_db()

    again()
    is_as_it_was(trial)
    press_run(bench, trial)
    assert goes_on(bench, trial).status == "running"
    found = trial.run, trial.episode_id, trial.run_event
    again()
    assert (trial.status, (trial.run, trial.episode_id, trial.run_event)) == ("running", found)


def test_a_run_that_was_stopped_before_it_began_is_no_attempt_that_counts(bench):
    trial = bench.bench.prepare()
    ready(bench, trial)
    press_run(bench, trial)
    bench.give(trial, "stop")  # before its recording is open
    goes_on(bench, trial)
    assert trial.status == "interrupted"
    with pytest.raises(Conflict, match=f"trial {trial.pk} cannot be scored: .* of its run has no rows"):
        bench.score(trial, True, True, True)
    assert (bench.bench.prepare().number, Trial.objects.latest("pk").attempt) == (1, 2)


def test_a_blind_plans_trial_keeps_its_place_and_its_code_and_says_why_without_telling_what_it_is_of(
    bench, disk, monkeypatch
):
    owner, first = builders.user("olga"), bench.bench.checkpoint
    other = Checkpoint.objects.create(name="secret-birch", policy={})
    drawn = Plan.objects.create(name="blocks", title="Blocks", owner=owner, repetitions=2, blind=True)
    drawn.checkpoints.set([first, other])
    drawn.positions.set(bench.bench.scene.positions.all())
    drawn = freeze_plan(user=owner, plan=drawn)
    monkeypatch.setattr(looking, "record_layout", lambda **given: [])
    handout = allocate_trial(user=bench.bench.operator, station=bench.bench.station, plan=drawn)
    trial, before = handout.trial, plan_progress(drawn)
    ready(bench, trial)
    fails_to_open(bench, disk, trial)
    is_as_it_was(trial)
    handout.refresh_from_db()
    assert (handout.trial, handout.number, plan_progress(drawn)) == (trial, 1, before)
    with pytest.raises(Conflict, match="is prepared: run it, or abandon it"):
        allocate_trial(user=bench.bench.operator, station=bench.bench.station, plan=drawn)
    seen = visibility_for_user(bench.bench.operator)
    assert seen.hides(trial)
    assert seen.reason(trial) == trial.reason
    for name in (first.name, other.name):
        assert name not in trial.reason
    press_run(bench, trial)
    assert goes_on(bench, trial).status == "running"
    bench.give(trial, "stop")
    assert (goes_on(bench, trial).status, trial.handout.code) == ("ended", handout.code)
