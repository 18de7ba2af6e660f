from uuid import uuid4

import pytest

from evaweb.episodes.models import Episode, EpisodeStatus
from evaweb.episodes.services import record_opened
from evaweb.jobs.models import Job
from evaweb.stations.models import Command
from evaweb.trials import services
from evaweb.trials.models import Trial
from evaweb.trials.station_commands import run_args
from tests.evaweb.trials.builders import BOOT


@pytest.fixture
def asked(bench):
    """A prepared trial and the command that runs it, whose answer has not arrived."""
    trial = bench.prepare()
    command = Command.objects.create(
        station=bench.station,
        user=bench.operator,
        kind="run",
        args=run_args(trial, bench.operator),
        boot=BOOT,
        status="unknown",
        data={"episode": str(uuid4())},
    )
    return trial, command


@pytest.fixture
def running(bench, asked):
    """A trial that runs, as the station's events tell it."""
    trial, command = asked
    bench.event(
        "command", "run by ann: accepted", 100.0, uuid=str(command.pk), **{"from": "ready"}, to="running"
    )
    trial.refresh_from_db()
    return trial


def enter(bench, state, time, why="because"):
    return bench.event("state", f"running -> {state}: {why}", time, state=state)


def test_the_event_of_an_accepted_run_begins_the_trial_even_where_the_answer_was_lost(bench, asked, running):
    assert (running.status, running.run, running.run_boot) == ("running", asked[1].pk, BOOT)
    assert str(running.episode_id) == asked[1].data["episode"]
    assert running.started_at is not None


def test_a_refused_run_begins_nothing(bench, asked):
    trial, command = asked
    bench.event("command", "run by ann: refused", uuid=str(command.pk), **{"from": "idle"}, to="idle")
    trial.refresh_from_db()
    assert trial.status == "prepared"


def test_a_run_that_is_no_trials_changes_no_trial(bench):
    trial = bench.prepare()
    plain = Command.objects.create(station=bench.station, kind="run", args={})
    for uuid in (str(plain.pk), str(uuid4()), "no uuid", ""):
        assert bench.event("command", uuid=uuid, **{"from": "ready"}, to="running") is None
    trial.refresh_from_db()
    assert trial.status == "prepared"


def test_pauses_do_not_count_in_the_duration(bench, running):
    assert enter(bench, "holding", 104.0, "lease lost").status == "paused"
    bench.event("command", "resume by ann: accepted", 150.0, **{"from": "holding"}, to="running")
    ended = bench.event("command", "stop by ann: accepted", 156.5, **{"from": "running"}, to="ready")
    assert ended.status == "ended"
    assert ended.duration_s == pytest.approx(10.5)
    assert ended.reason == "stop by ann"
    assert ended.ended_at is not None


def test_a_paused_trial_says_why_and_a_resumed_one_does_not(bench, running):
    assert enter(bench, "holding", 104.0, "the policy does not answer").reason == "the policy does not answer"
    assert enter(bench, "running", 105.0).reason == ""


@pytest.mark.parametrize("state", ["faulted", "idle", "disconnected"])
def test_what_neither_holds_nor_ends_it_interrupts_it(bench, running, state):
    found = enter(bench, state, 103.0, "the e-stop was pressed")
    assert (found.status, found.reason) == ("interrupted", "the e-stop was pressed")
    assert found.duration_s == pytest.approx(3.0)


def test_what_ended_its_run_is_kept_when_it_ends(bench, running):
    assert enter(bench, "faulted", 103.0, "the e-stop was pressed").ended_by == "estop"
    facts = {"uuid": str(running.episode_id), "status": "finished", "rows": 9, "reason": ""}
    bench.event("episode_closed", "", 104.0, **facts)
    running.refresh_from_db()
    assert running.ended_by == "estop"


def test_a_run_that_ended_by_itself_says_so_until_its_recording_is_not_whole(bench, running):
    assert (
        bench.event("command", "stop by ann: accepted", 156.5, **{"from": "running"}, to="ready").ended_by
        == ""
    )
    facts = {"uuid": str(running.episode_id), "status": "failed", "rows": 9, "reason": "disk"}
    bench.event("episode_closed", "", 157.0, **facts)
    running.refresh_from_db()
    assert (running.status, running.ended_by) == ("interrupted", "interruption")


def test_every_event_twice_and_out_of_order_leaves_the_same_trial(bench, running):
    rows = [
        {
            "number": 2,
            "kind": "state",
            "text": "a -> holding: x",
            "time": 101.0,
            "data": {"state": "holding"},
        },
        {
            "number": 3,
            "kind": "state",
            "text": "a -> running: x",
            "time": 102.0,
            "data": {"state": "running"},
        },
        {"number": 4, "kind": "state", "text": "a -> ready: time", "time": 105.0, "data": {"state": "ready"}},
    ]
    for row in (rows[0], rows[0], rows[1], rows[0], rows[2], rows[1], rows[0], rows[2]):
        services.apply_station_event(station=bench.station, event=row, boot=BOOT)
    running.refresh_from_db()
    assert running.status == "ended"
    assert running.duration_s == pytest.approx(4.0)


def test_events_from_before_the_run_do_not_touch_it(bench, running):
    old = {"number": 0, "kind": "state", "text": "", "time": 1.0, "data": {"state": "faulted"}}
    assert services.apply_station_event(station=bench.station, event=old, boot=BOOT) is None
    running.refresh_from_db()
    assert running.status == "running"


def test_another_stations_events_do_not_touch_it(bench, running):
    from evaweb.stations.models import Station

    other = Station.objects.create(name="bench-2", robot="agilex_piper")
    row = {"number": 9, "kind": "state", "text": "", "time": 1.0, "data": {"state": "faulted"}}
    assert services.apply_station_event(station=other, event=row, boot=BOOT) is None
    ours = str(running.episode_id)
    for number, (kind, data) in enumerate(
        [
            ("truth", {"episode": ours, "success": True}),
            ("episode_closed", {"uuid": ours, "status": "failed"}),
        ]
    ):
        row = {"number": 10 + number, "kind": kind, "text": "", "time": 1.0, "data": data}
        assert services.apply_station_event(station=other, event=row, boot=BOOT) is None
    running.refresh_from_db()
    assert (running.status, running.truth) == ("running", None)


def test_a_restarted_station_interrupts_what_was_under_way(bench, running):
    row = {"number": 0, "kind": "state", "text": "restarted -> idle", "time": None, "data": {"state": "idle"}}
    found = services.apply_station_event(station=bench.station, event=row, boot="boot-2")
    assert found.status == "interrupted"
    assert "restarted" in found.reason


def test_a_run_that_ended_while_the_web_was_away_has_ended(bench, running):
    whole = {"status": EpisodeStatus.FINISHED, "duration_s": 9.25, "frames": 278}
    Episode.objects.filter(pk=running.episode_id).update(**whole)
    row = {"number": 0, "kind": "state", "text": "restarted -> idle", "time": None, "data": {"state": "idle"}}
    found = services.apply_station_event(station=bench.station, event=row, boot="boot-2")
    assert (found.status, found.duration_s) == ("ended", 9.25)


def test_the_recordings_duration_is_the_exact_one(bench, running):
    enter(bench, "ready", 110.0)
    Episode.objects.filter(pk=running.episode_id).update(duration_s=9.9)
    found = bench.event("episode_closed", uuid=str(running.episode_id), status="finished", reason="stopped")
    assert (found.status, found.duration_s) == ("ended", 9.9)


def test_a_closed_recording_ends_a_trial_whose_other_events_are_lost(bench, running):
    found = bench.event(
        "episode_closed", "", 108.0, uuid=str(running.episode_id), status="finished", reason="its time was up"
    )
    assert (found.status, found.reason) == ("ended", "its time was up")


@pytest.mark.parametrize("status", ["interrupted", "failed"])
def test_a_recording_that_is_not_whole_makes_an_ended_trial_an_interrupted_one(bench, running, status):
    enter(bench, "ready", 110.0)
    found = bench.event(
        "episode_closed", uuid=str(running.episode_id), status=status, reason="media was restarted"
    )
    assert found.status == "interrupted"
    assert "media was restarted" in found.reason


def test_a_trial_that_was_scored_before_its_recording_closed_stays_scored_and_is_published(bench, running):
    enter(bench, "ready", 110.0)
    Episode.objects.filter(pk=running.episode_id).update(frames=300)
    ticks = bench.ticks(True, True, True)
    services.score_trial(user=bench.operator, trial=running, milestones=ticks)
    Job.objects.all().delete()
    found = bench.event("episode_closed", uuid=str(running.episode_id), status="failed", reason="disk full")
    assert found.status == "scored"
    assert Job.objects.filter(key=f"publish:{running.episode_id}").count() == 1


def test_a_recording_that_waits_for_room_ends_nothing_until_it_is_closed(bench, running):
    enter(bench, "ready", 110.0)
    told = {"uuid": str(running.episode_id), "rows": 300}
    assert bench.event("episode_closed", status="failed", reason="disk full", waits=True, **told) is None
    running.refresh_from_db()
    assert running.status == "ended"
    found = bench.event("episode_closed", status="finished", reason="stopped", waits=False, **told)
    assert (found.status, found.ended_at) == ("ended", running.ended_at)


@pytest.mark.parametrize("before", ["running", "ended"])
def test_a_recording_without_a_row_is_of_no_attempt_that_counts(bench, running, before):
    if before == "ended":
        enter(bench, "ready", 100.02)
    closed = {"uuid": str(running.episode_id), "status": "finished", "reason": "stopped", "rows": 0}
    found = bench.event("episode_closed", **closed)
    assert (found.status, found.reason) == ("interrupted", "nothing of it was recorded: stopped")
    assert bench.prepare().attempt == 2


def test_a_run_that_ended_before_it_began_is_interrupted_even_where_the_station_is_ready(bench, running):
    never = {"command": str(running.run), "episode": str(running.episode_id), "unopened": False}
    found = bench.event("state", "running -> ready: stopped", 100.1, state="ready", unbegun=never)
    assert found.status == "interrupted"


def test_the_truth_of_a_simulated_bench_is_kept_with_its_trial(bench, running):
    told = {"episode": str(running.episode_id), "success": True, "milestones": {"placed": True}}
    assert bench.event("truth", "the bench says", **told).truth == told
    assert bench.event("truth", "the bench says", **{**told, "episode": str(uuid4())}) is None


def test_an_episode_whose_name_was_lost_is_asked_for_and_bound_to_its_trial(bench, asked, monkeypatch):
    trial, command = asked
    uuid = command.data.pop("episode")
    command.save()
    bench.event("command", "", 100.0, uuid=str(command.pk), **{"from": "ready"}, to="running")
    trial.refresh_from_db()
    assert (trial.status, trial.episode) == ("running", None)

    def settled(*, row):
        row.data = {"episode": uuid}
        return row

    monkeypatch.setattr("evaweb.trials.station_events.resolve_unknown_outcome", settled)
    assert bench.event("episode_closed", uuid=str(uuid4()), status="finished") is None
    found = bench.event("episode_closed", "", 109.0, uuid=uuid, status="finished", reason="stopped")
    assert (found.pk, str(found.episode_id), found.status) == (trial.pk, uuid, "ended")


def test_a_recording_without_a_run_belongs_to_no_trial(bench, running):
    record_opened(station=bench.station, uuid=(alone := uuid4()))
    assert bench.event("episode_closed", uuid=str(alone), status="finished", reason="") is None
    running.refresh_from_db()
    assert running.status == "running"


def test_a_trial_that_was_given_up_too_early_is_taken_up_again(bench, asked):
    trial, command = asked
    services.abandon_trial(user=bench.operator, trial=trial)
    bench.event("command", "", 100.0, uuid=str(command.pk), **{"from": "ready"}, to="running")
    trial.refresh_from_db()
    assert trial.status == "running"


def test_it_is_left_where_the_station_has_another_trial_by_now(bench, asked, caplog):
    trial, command = asked
    services.abandon_trial(user=bench.operator, trial=trial)
    bench.prepare()
    bench.event("command", "", 100.0, uuid=str(command.pk), **{"from": "ready"}, to="running")
    trial.refresh_from_db()
    assert trial.status == "abandoned"
    assert "accepted its run" in caplog.text


@pytest.mark.parametrize("data", [None, {}, {"state": 3}, {"to": None}])
def test_events_that_say_nothing_change_nothing(bench, running, data):
    row = {"number": 50, "kind": "state", "text": None, "time": None, "data": data}
    before = Trial.objects.values().get(pk=running.pk)
    found = services.apply_station_event(station=bench.station, event=row, boot=BOOT)
    assert found is None or data == {"state": 3}
    if found is None:
        assert Trial.objects.values().get(pk=running.pk) == before
