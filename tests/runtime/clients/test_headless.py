import itertools
import math
from copy import deepcopy
from types import SimpleNamespace

import pytest

from runtime import __main__ as command_line
from runtime.clients import headless
from runtime.clients.headless import run_headless, summary
from runtime.core.errors import RecordingError, RuntimeFault, SetupError, TransportError
from runtime.recording import export
from tests.sources import ROOT
from tests.standing import state_flags

STATUS = {
    "boot": "boot-1",
    **state_flags("idle"),
    "reason": "",
    "stage": "idle",
    "mode": "continuous",
    "phase": "executing",
    "newest_event": 0,
    "run": {"number": 0, "elapsed": 0.0},
    "last_run": {},
    "recording": {"uuid": "", "rows": 0},
    "episode": {},
    "control": {"rate": 30.0, "lateness_p99_ms": 0.25, "missed": 1},
    "policy": {
        "answers": 40,
        "latency_p50_ms": 81.6,
        "latency_p90_ms": 95.0,
        "delay_p50": 3.0,
        "delay_max": 4,
        "lost": False,
    },
    "lease": {"holder": "headless"},
    "link": {"rates": {"joints": 30.0, "cam_high": 30.0}},
}
RUNNING = {"number": 1, "elapsed": 8.0}
FINISHED = {"number": 1, "status": "finished", "reason": "the run's 8 s are over"}
CLOSED = {"path": "/data/episodes/one", "status": "finished", "rows": 240}


def status(state, **changes):
    return deepcopy(STATUS) | state_flags(state) | changes


def event(number, kind, text=""):
    return {"number": number, "kind": kind, "text": text}


class Station:
    """Answers with one status after the other, the last for ever; an exception is raised."""

    def __init__(self, *statuses, events=()):
        self.statuses, self.events, self.given = list(statuses), list(events), []

    def status(self):
        found = self.statuses.pop(0) if len(self.statuses) > 1 else self.statuses[0]
        if isinstance(found, Exception):
            raise found
        newest = max((e["number"] for e in self.events), default=0)
        return {"newest_event": newest} | found if "newest_event" not in found else found

    def claim(self):
        self.given.append("claim")

    def renew(self):
        assert "claim" in self.given

    def command(self, kind):
        self.given.append(kind)

    def events_since(self, number):
        return [e for e in self.events if e["number"] > number]


@pytest.fixture(autouse=True)
def clock(monkeypatch):
    """Sleeping and looking at the clock take no time but the test's."""
    now = itertools.count(0.0, 0.5)
    monkeypatch.setattr(headless.time, "sleep", lambda _: None)
    monkeypatch.setattr(headless.time, "monotonic", lambda: next(now))


@pytest.fixture
def plan(tmp_path):
    publish, run = SimpleNamespace(dataset=None), SimpleNamespace(mode="continuous")
    return SimpleNamespace(publish=publish, data=tmp_path, run=run, station="bench-1")


@pytest.fixture(autouse=True)
def files(monkeypatch):
    """What is on disk of an episode: here nothing, only what would be read from it."""
    found = {"duration_s": 8.0, "safety": {"ticks": 240, "refused": 0, "limited": 2}}
    monkeypatch.setattr(headless, "_episode_figures", lambda path: found)
    return found


@pytest.fixture(autouse=True)
def kept(monkeypatch):
    """What was exported and published, in this order."""
    done = []

    def exported(episode, root):
        done.append("export")
        return root / "exports" / episode.name

    def published(plan, episode):
        done.append("publish")
        return {"dataset_path": "/data/datasets/demo", "episode_index": 4, "published_frames": 240}

    monkeypatch.setattr(export, "write_export", exported)
    monkeypatch.setattr(headless, "_publish", published)
    return done


def a_good_run(*events):
    return Station(
        TransportError("not running here"),
        status("disconnected"),
        status("disconnected", newest_event=0),
        status("idle"),
        status("setting_up", stage="warming up"),
        status("ready"),
        status("running", run=RUNNING, newest_event=2),
        status("ready", reason=FINISHED["reason"], last_run=FINISHED, newest_event=2),
        status("ready", reason=FINISHED["reason"], last_run=FINISHED, episode=CLOSED, newest_event=9),
        events=[event(1, "command"), event(2, "episode_opened"), *events, event(9, "episode_closed")],
    )


def test_a_run_is_set_up_run_and_its_end_on_disk_waited_for(plan, capsys):
    station = a_good_run()
    result = run_headless(plan, station)
    assert station.given == ["claim", "setup", "run"]
    assert (result["ended"], result["frames"], result["episode_status"]) == (
        FINISHED["reason"],
        240,
        "finished",
    )
    assert result["run_seconds"] == 8.0
    shown = capsys.readouterr().out
    assert "RUNNING (continuous, executing)  8.0 s" in shown
    assert "/data/episodes/one" in shown


def test_events_that_matter_are_told_once_and_others_not(plan, capsys):
    run_headless(
        plan, a_good_run(event(3, "chunk_dropped", "chunk 7 dropped"), event(4, "command", "stop by anna"))
    )
    shown = capsys.readouterr().out
    assert shown.count("  chunk_dropped: chunk 7 dropped\n") == 1
    assert "stop by anna" not in shown


def test_the_events_of_another_main_are_read_from_its_first(plan, capsys):
    station = Station(
        status("idle", newest_event=40),
        status("idle", newest_event=40),
        status("setting_up", newest_event=40),
        status("idle", boot="boot-2", newest_event=1, reason="the process coordinator died"),
        events=[event(40, "state", "of the first"), event(1, "state", "of the second")],
    )
    station.events_since = lambda number: [e for e in station.events if e["number"] == number + 1]
    with pytest.raises(RuntimeFault, match="set-up failed: the process coordinator died"):
        run_headless(plan, station)
    assert "of the second" in capsys.readouterr().out


def test_a_set_up_that_fails_is_an_error_with_its_reason(plan):
    station = Station(status("idle"), status("idle"), status("idle", reason="no policy server listens"))
    with pytest.raises(RuntimeFault, match="set-up failed: no policy server listens"):
        run_headless(plan, station)
    assert station.given == ["claim", "setup"]


def test_a_run_that_fell_back_without_an_episode_raises_at_once_with_its_reason(plan, capsys, monkeypatch):
    failed = {"number": 1, "status": "failed", "reason": "3 GB free, 1000 needed"}
    station = Station(
        *[status("idle")] * 2, status("ready"), status("ready", reason=failed["reason"], last_run=failed)
    )
    monkeypatch.setattr(headless, "_CLOSE_S", -math.inf)  # any wait for the episode would be an error
    with pytest.raises(RuntimeFault, match="did not end well: 3 GB free, 1000 needed; episode: none"):
        run_headless(plan, station)
    assert "ended     3 GB free, 1000 needed" in capsys.readouterr().out


def test_a_run_that_is_not_recorded_ends_without_waiting_for_an_episode(plan, monkeypatch):
    station = Station(
        *[status("idle")] * 2,
        *[status("ready")] * 1,
        status("running", run=RUNNING),
        status("ready", reason=FINISHED["reason"], last_run=FINISHED),
    )
    monkeypatch.setattr(headless, "_CLOSE_S", -math.inf)
    result = run_headless(plan, station)
    assert (result["episode_path"], result["frames"]) == ("", 0)


def test_a_run_that_held_is_stopped_and_no_success_although_it_was_recorded(plan):
    held = status("holding", reason="policy lost", newest_event=1)
    station = Station(
        *[status("idle")] * 2,
        status("ready"),
        held,
        status("ready", last_run=FINISHED, newest_event=1),
        status("ready", last_run=FINISHED, episode=CLOSED, newest_event=2),
        events=[event(1, "episode_opened"), event(2, "episode_closed")],
    )
    with pytest.raises(RuntimeFault, match="did not end well: policy lost; episode: /data/episodes/one"):
        run_headless(plan, station)
    assert station.given[-1] == "stop"


def test_an_episode_that_is_never_closed_is_an_error(plan):
    station = Station(
        *[status("idle")] * 2,
        status("ready"),
        status("ready", reason="over", last_run=FINISHED, newest_event=1),
        events=[event(1, "episode_opened")],
    )
    with pytest.raises(
        RuntimeFault,
        match=r"ended \(over\), but then: the end of the recording: not within 30 s; ready: over",
    ):
        run_headless(plan, station)


def test_an_episode_that_cannot_be_read_is_no_success(plan, monkeypatch):
    def damaged(path):
        raise RecordingError("rows.arrow is damaged")

    monkeypatch.setattr(headless, "_episode_figures", damaged)
    with pytest.raises(
        RuntimeFault, match=r"the run ended \(the run's 8 s are over\), but then: rows.arrow is damaged"
    ):
        run_headless(plan, a_good_run())


@pytest.mark.parametrize(
    ("mode", "dataset", "done"),
    [
        ("continuous", None, ["export"]),
        ("continuous", "demo", ["export", "publish"]),
        ("sim", "demo", ["export"]),  # it moved no robot
    ],
)
def test_every_run_is_exported_and_what_moved_a_robot_is_published(plan, kept, mode, dataset, done):
    plan.run.mode, plan.publish.dataset = mode, dataset
    result = run_headless(plan, a_good_run())
    assert kept == done
    assert result["export_path"] == str(plan.data / "exports" / "one")
    assert ("dataset_path" in result) is ("publish" in done)


def test_a_run_that_did_not_end_well_is_exported_and_not_published(plan, kept):
    plan.publish.dataset = "demo"
    station = a_good_run()
    station.statuses[-1] = station.statuses[-1] | {"last_run": FINISHED | {"status": "failed"}}
    with pytest.raises(RuntimeFault, match="did not end well"):
        run_headless(plan, station)
    assert kept == ["export"]


def test_an_export_that_fails_is_told_on_top_of_how_the_run_ended(plan, monkeypatch):
    def full(episode, root):
        raise RecordingError("the disk is full")

    monkeypatch.setattr(export, "write_export", full)
    with pytest.raises(RuntimeFault, match=r"ended \(the run's 8 s are over\), but then: the disk is full"):
        run_headless(plan, a_good_run())


@pytest.mark.parametrize("mode", ["step", "preview", "manual"])
def test_a_mode_that_needs_a_person_is_refused_before_anything_is_done(plan, mode):
    plan.run.mode = mode
    station = Station(status("idle"))
    says = f"run.mode = '{mode}' needs a person; headless: continuous, sim.*ctl bench-1 run --mode {mode}"
    with pytest.raises(SetupError, match=says):
        run_headless(plan, station)
    assert station.given == []


def test_such_a_mode_is_refused_before_any_process_is_started(monkeypatch, capsys):
    monkeypatch.setattr(command_line, "Supervisor", None)
    deployment = str(ROOT / "deployments/demo.toml")
    assert command_line.main([deployment, "--headless", "--set", "run.mode=preview"]) == 2
    assert "run.mode = 'preview' needs a person" in capsys.readouterr().err


def test_the_summary_says_how_it_went():
    result = {
        "ended": "the run's 8 s are over",
        "run_seconds": 8.0,
        "frames": 240,
        "duration_s": 8.0,
        "episode_status": "finished",
        "episode_path": "/data/episodes/one",
        "policy": STATUS["policy"],
        "control": STATUS["control"],
        "safety": {"ticks": 240, "refused": 3, "limited": 2},
        "export_path": "/data/exports/fold/continuous/async/one.parquet",
        "dataset_path": "/data/datasets/demo",
        "episode_index": 4,
        "published_frames": 240,
    }
    assert summary(result) == [
        "",
        "How it went",
        "  ended     the run's 8 s are over, after 8.0 s",
        "  recorded  240 rows, 8.0 s, finished",
        "  policy    p50 82 ms, p90 95 ms, delay 3 ticks, at most 4",
        "  control   30 Hz, ticks late by p99 0.25 ms, 1 missed",
        "  safety    3 of 240 ticks refused, 2 limited",
        "  episode   /data/episodes/one",
        "  streams   /data/exports/fold/continuous/async/one.parquet",
        "  dataset   /data/datasets/demo  episode 4, 240 frames",
    ]
