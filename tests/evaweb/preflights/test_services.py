"""Preflights are asked for where they can be flown, kept, and never left open."""

from datetime import timedelta
from uuid import uuid4

import pytest
from django.utils import timezone

from evaweb.core.errors import Conflict, NotAllowed, StationGone
from evaweb.jobs.models import Job, JobStatus
from evaweb.jobs.services import run_queue
from evaweb.preflights import job_kinds
from evaweb.preflights.models import Preflight, PreflightStatus, Verdict
from evaweb.preflights.services import refresh_preflight, refresh_preflights, start_preflight
from evaweb.stations.models import Station
from evaweb.stations.runtime_client import NoAnswer
from runtime.preflight import verdict as runtimes_own
from tests.evaweb.preflights.conftest import CLOSED, OK, Runtime
from tests.evaweb.trials import builders

pytestmark = pytest.mark.django_db


def told(runtime, row, report=None, failure=""):
    runtime.told[str(row.pk)] = {"running": False, "report": report, "failure": failure}


@pytest.fixture
def ask(bench, checkpoint, runtime):
    return lambda **given: start_preflight(
        **{"user": bench.operator, "checkpoint": checkpoint, "station": bench.station, **given}
    )


def test_the_station_is_asked_with_the_checkpoints_table(ask, bench, checkpoint, runtime):
    row = ask()
    command = runtime.heard[-1]
    assert (command.kind, command.user) == ("preflight", bench.operator.username)
    assert command.args["policy"] == checkpoint.policy == row.policy
    assert command.args["checkpoint"] == {"id": checkpoint.pk, "name": checkpoint.name}
    assert command.args["id"] == str(row.pk)
    assert (row.status, row.by, row.report) == ("running", "station", None)
    assert row.over_by - timezone.now() > timedelta(seconds=250)


def test_it_is_asked_as_the_checkpoint_is_served(ask, checkpoint, runtime):
    assert "strategy" not in (ask(), runtime.heard[-1])[1].args
    checkpoint.strategy = {"kind": "rtc"}
    ask()
    assert runtime.heard[-1].args["strategy"] == {"kind": "rtc"}


def test_its_report_is_kept_when_somebody_looks(ask, runtime):
    row = ask()
    assert refresh_preflight(row=row).status == "running"
    told(runtime, row, OK)
    settled = refresh_preflight(row=row)
    assert (settled.status, settled.verdict, settled.report) == ("done", "ok", OK)
    assert settled.ended_at
    runtime.told.clear()
    assert refresh_preflight(row=settled).report == OK


def test_it_is_kept_too_where_nobody_looks(ask, bench, runtime):
    row = ask()
    assert refresh_preflights(station=bench.station) == 0
    told(runtime, row, CLOSED)
    assert refresh_preflights(station=bench.station) == 1
    row.refresh_from_db()
    assert row.verdict == "port_closed"


def test_one_without_a_report_says_why(ask, runtime):
    row = ask()
    told(runtime, row, failure="cancelled: setup by ann")
    assert (refresh_preflight(row=row).status, row.reason) == ("lost", "cancelled: setup by ann")


def test_a_station_that_was_restarted_knows_nothing_of_it(ask, runtime):
    row = ask()
    runtime.told.clear()
    assert refresh_preflight(row=row).status == "lost"
    assert "restarted meanwhile" in row.reason


def test_a_station_that_has_gone_loses_it_and_one_that_is_slow_does_not(ask, runtime):
    row = ask()
    runtime.lost = {"preflight_report"}
    assert refresh_preflight(row=row).status == "running"
    Preflight.objects.filter(pk=row.pk).update(over_by=timezone.now() - timedelta(seconds=1))
    row.refresh_from_db()
    assert refresh_preflight(row=row).reason.endswith("has not answered since")
    row = ask(station=row.station)
    runtime.lost, runtime.gone = set(), StationGone("bench-1 is not running")
    assert refresh_preflight(row=row).reason == "bench-1 is not running"


def test_what_the_station_refuses_leaves_nothing(ask, runtime):
    runtime.refuses = "preflight is not allowed while running: the policy is at work"
    with pytest.raises(Conflict, match="not allowed while running"):
        ask()
    assert not Preflight.objects.exists()


def test_an_answer_that_was_lost_is_found_out_later(ask, runtime):
    runtime.lost = {"preflight"}
    row = ask()
    assert row.status == "running"
    told(runtime, row, OK)
    assert refresh_preflight(row=row).verdict == "ok"


def test_a_station_that_hangs_is_no_reason_for_another_way(ask, runtime):
    runtime.gone = NoAnswer("bench-1 has not answered")
    with pytest.raises(NoAnswer):
        ask()
    assert not Preflight.objects.exists()


@pytest.mark.parametrize("state", ["setting_up", "running", "holding"])
@pytest.mark.parametrize("old", [False, True])
def test_a_server_that_another_station_is_at_work_with_is_left_alone(ask, runtimes, other, state, old):
    runtimes[other.name] = Runtime(state=state, old=old)
    with pytest.raises(Conflict, match=r"bench-2 is .* with the same policy server"):
        ask()
    runtimes[other.name].server = "127.0.0.1:8001"
    assert ask().status == "running"


@pytest.mark.parametrize("state", ["idle", "ready", "faulted", "disconnected"])
def test_a_station_that_only_could_use_the_server_is_not_disturbed(ask, runtimes, other, state):
    runtimes[other.name] = Runtime(state=state)
    assert ask().status == "running"


def test_without_a_station_the_first_that_is_free_is_taken(ask, runtimes, runtime, other):
    runtimes[other.name] = Runtime(server="")
    runtime.state = "running"
    assert ask(station=None).station == other
    runtime.state = "ready"
    assert ask(station=None).station.name == "bench-1"


def test_where_none_is_free_or_known_that_is_said(ask, runtime, other):
    runtime.state = "running"
    with pytest.raises(Conflict, match="no station is free"):
        ask(station=None)


def test_a_viewer_asks_for_none(ask):
    with pytest.raises(NotAllowed):
        ask(user=builders.user("vic", "viewer"))


# --- by the worker


@pytest.fixture
def resting(other, tmp_path):
    """A station that does not run, whose deployment file is known."""
    file = tmp_path / "bench-2.toml"
    file.write_text(
        'station = "bench-2"\nrobot = "agilex_piper"\n[transport]\nkind = "zmq"\n[policy]\nkind = "openpi"\n'
    )
    Station.objects.filter(pk=other.pk).update(deployment=str(file))
    other.refresh_from_db()
    return other


def test_where_the_station_does_not_run_the_worker_asks(ask, resting, checkpoint, monkeypatch):
    asked = []
    monkeypatch.setattr(
        "runtime.station.preflight_child.run_preflight",
        lambda line, longest: asked.append(line) or dict(CLOSED),
    )
    row = ask(station=resting)
    assert (row.by, row.status) == ("worker", "running")
    assert refresh_preflight(row=row).status == "running"
    assert run_queue("station") == 1
    assert refresh_preflight(row=row).status == "running" or row.verdict == "port_closed"
    row.refresh_from_db()
    assert (row.status, row.verdict) == ("done", "port_closed")
    assert asked == [{"deployment": resting.deployment, "changes": {"policy": checkpoint.policy}}]
    assert Job.objects.get().result == {"verdict": "port_closed"}


def test_a_job_that_is_done_twice_asks_once(ask, resting, monkeypatch):
    asked = []
    monkeypatch.setattr(
        "runtime.station.preflight_child.run_preflight", lambda line, longest: asked.append(line) or dict(OK)
    )
    row = ask(station=resting)
    done = job_kinds.JobContext({"preflight": str(row.pk)}, lambda text: None)
    assert job_kinds.preflight(done) == job_kinds.preflight(done) == {"verdict": "ok"}
    assert len(asked) == 1


def test_the_workers_errors_are_the_reason(ask, resting):
    row = ask(station=resting)
    Job.objects.update(status=JobStatus.FAILED, error="preflight: its process exited with -9")
    assert refresh_preflight(row=row).reason == "preflight: its process exited with -9"
    row = ask(station=resting)
    Job.objects.all().delete()
    assert "its job is gone" in refresh_preflight(row=row).reason
    row = ask(station=resting)
    Preflight.objects.filter(pk=row.pk).update(asked_at=timezone.now() - timedelta(hours=2))
    row.refresh_from_db()
    assert "No worker is running" in refresh_preflight(row=row).reason


def test_the_worker_too_leaves_a_server_alone_that_is_at_work(ask, resting, runtime):
    runtime.state = "running"
    with pytest.raises(Conflict, match="same policy server"):
        ask(station=resting)
    assert not Job.objects.exists()


def test_a_station_without_a_deployment_file_is_said_to_have_none(ask, other):
    with pytest.raises(StationGone, match="deployment file is not known here"):
        ask(station=other)


def test_a_table_that_fits_no_deployment_is_what_the_report_says(ask, resting, checkpoint):
    checkpoint.policy = {"uri": "ws://x"}
    checkpoint.save()
    assert ask(station=resting).by == "worker"


def test_verdicts_have_the_runtimes_words():
    assert set(Verdict.values) == set(runtimes_own.PreflightVerdict)


def test_a_row_says_in_words_how_it_stands(ask):
    row = ask()
    assert (row.label, row.tone) == ("under way", "ok")
    row.status, row.report = PreflightStatus.DONE, OK
    assert (row.label, row.tone) == ("usable", "active")
    row.report = CLOSED
    assert (row.label, row.tone) == ("port closed", "danger")
    row.report = {"verdict": "something_new"}
    assert row.label == "something_new"
    row.status, row.report = PreflightStatus.LOST, None
    assert (row.label, row.tone) == ("without a report", "warn")
    assert "bench-1" in str(row)
    assert uuid4() != row.pk
