import json
import math
from copy import deepcopy

import pytest

from runtime import ctl
from runtime.client import Refused
from runtime.errors import TransportError
from runtime.messages import Ack

STATUS = {
    "boot": "boot-1",
    "station": "bench-1",
    "state": "ready",
    "reason": "set up",
    "stage": "idle",
    "newest_event": 0,
    "control": {"lateness_p99_ms": 0.5, "missed": 2},
    "policy": {"latency_p50_ms": math.nan, "delay_p50": math.nan},
    "link": {"rates": {"joints": 30.0}},
    "run": {"number": 0, "elapsed": 0.0},
    "recording": {"uuid": "", "rows": 0},
    "lease": {"holder": ""},
}


def status(state="ready", **changes):
    return deepcopy(STATUS) | {"state": state} | changes


class Script:
    """A station that answers as written down; a status that is an exception is raised."""

    holder = "terminal:me"

    def __init__(self, statuses=(), refusal=None, streams=(), events=()):
        self.statuses, self.refusal, self.streams = list(statuses), refusal, list(streams)
        self.events = list(events)
        self.given, self.subscribed, self.closed = [], 0, False

    def __call__(self, folder):
        self.folder = folder
        return self

    def status(self):
        found = self.statuses.pop(0) if len(self.statuses) > 1 else self.statuses[0]
        if isinstance(found, BaseException):
            raise found
        return found

    def command(self, kind, **arguments):
        self.given.append((kind, arguments) if arguments else kind)
        if self.refusal:
            raise self.refusal

    def renew(self):
        self.given.append("renew")

    def estop(self, why):
        self.given.append(("estop", why))
        return Ack(
            "u", "failed" if self.refusal else "done", "USE THE HARDWARE STOP" if self.refusal else "ok"
        )

    def subscribe(self, *streams):
        self.subscribed += 1
        return self

    def receive(self, timeout):
        found = self.streams.pop(0)
        if isinstance(found, BaseException):
            raise found
        return found

    def events_since(self, number):
        return [event for event in self.events if event["number"] > number]

    def close(self):
        self.closed = True


@pytest.fixture
def run(monkeypatch):
    """Runs a command line against a script; waits take no time."""
    monkeypatch.setattr(ctl.time, "sleep", lambda _: None)
    monkeypatch.setenv("EVA_DATA_DIR", "/var/eva")

    def run(script, *arguments):
        monkeypatch.setattr(ctl, "StationClient", script)
        return ctl.main(["bench-1", *arguments])

    return run


def test_the_station_is_looked_for_in_the_data_folder(run):
    script = Script([status()])
    assert run(script, "status") == 0
    assert str(script.folder) == "/var/eva/stations/bench-1"
    assert script.closed
    run(script, "status", "--data-dir", "~/eva")
    assert "~" not in str(script.folder)


def test_a_status_is_one_line_or_json(run, capsys):
    run(Script([status()]), "status")
    assert capsys.readouterr().out == "READY: set up  tick p99 0.50 ms, 2 missed\n"
    run(Script([status()]), "status", "--json")
    assert json.loads(capsys.readouterr().out)["state"] == "ready"


def test_the_line_of_a_run_says_how_it_is_going():
    running = status(
        "running",
        reason="",
        run={"number": 1, "elapsed": 12.34},
        recording={"uuid": "u", "rows": 370},
        policy={"latency_p50_ms": 81.6, "delay_p50": 2.0},
        link={"rates": {"joints": 60.0, "cam_high": 30.1, "cam_low": 14.6}},
    )
    assert ctl.line(running) == (
        "RUNNING  12.3 s  370 rows  policy 82 ms, delay 2  tick p99 0.50 ms, 2 missed  cameras 15 Hz"
    )
    assert "SETTING_UP (warming up): set up" in ctl.line(status("setting_up", stage="warming up"))


def test_a_delay_that_is_not_known_yet_is_a_dash():
    asked = status(policy={"latency_p50_ms": 81.6, "delay_p50": math.nan})
    assert "policy 82 ms, delay -" in ctl.line(asked)


@pytest.mark.parametrize("command", ["status", "watch"])
def test_a_lease_is_named_where_somebody_else_holds_it(run, capsys, command):
    theirs, mine = status(lease={"holder": "anna"}), status(lease={"holder": Script.holder})
    run(Script([theirs], streams=[{"state": theirs}, KeyboardInterrupt()]), command)
    assert capsys.readouterr().out.endswith("  lease: anna\n")
    run(Script([mine], streams=[{"state": mine}, KeyboardInterrupt()]), command)
    assert "lease" not in capsys.readouterr().out


@pytest.mark.parametrize("kind", ["stop", "halt", "release"])
def test_a_short_command_is_given_and_the_state_shown(run, capsys, kind):
    script = Script([status()])
    assert run(script, kind) == 0
    assert script.given == [kind]
    assert "READY" in capsys.readouterr().out


def test_a_recording_is_started_and_stopped(run):
    script = Script([status()])
    assert run(script, "record", "start") == 0
    assert run(script, "record", "stop") == 0
    assert script.given == ["record_start", "record_stop"]


def test_a_recording_needs_to_know_what(run, capsys):
    with pytest.raises(SystemExit):
        run(Script([status()]), "record")
    assert "record needs start or stop" in capsys.readouterr().err


def test_a_refusal_is_told_and_is_no_success(run, capsys):
    assert run(Script([status()], Refused("anna holds the lease")), "stop") == 1
    assert capsys.readouterr().err == "refused: anna holds the lease\n"


def test_a_station_that_is_gone_is_told_and_is_no_success(run, capsys):
    assert run(Script([TransportError("station 'bench-1' is not running here")]), "status") == 1
    assert capsys.readouterr().err == "error: station 'bench-1' is not running here\n"


@pytest.mark.parametrize(
    ("kind", "while_", "end", "code"),
    [
        ("setup", "setting_up", "ready", 0),
        ("setup", "setting_up", "idle", 1),  # it failed
        ("home", "setting_up", "ready", 0),
        ("home", "setting_up", "idle", 1),
        ("run", "running", "ready", 0),
        ("run", "running", "holding", 1),
        ("run", "running", "faulted", 1),
        ("resume", "running", "ready", 0),
    ],
)
def test_a_lasting_command_keeps_the_lease_and_its_end_is_the_exit_code(run, kind, while_, end, code):
    script = Script([status(while_), status(while_), status(end)])
    assert run(script, kind) == code
    assert script.given == [kind, "renew", "renew"]


def test_ctrl_c_stops_what_was_begun(run):
    script = Script([status("running"), KeyboardInterrupt(), status("ready")])
    assert run(script, "run") == 0
    assert script.given == ["run", "renew", "stop"]


def test_ctrl_c_before_the_answer_stops_too(run):
    script = Script([status("ready")], KeyboardInterrupt())

    def interrupted_once(kind):
        refusal, script.refusal = script.refusal, None
        script.given.append(kind)
        if refusal:
            raise refusal

    script.command = interrupted_once
    assert run(script, "run") == 0
    assert script.given == ["run", "stop"]


def test_the_estop_says_whether_it_was_obeyed(run, capsys):
    script = Script()
    assert run(script, "estop", "arm too low") == 0
    assert script.given == [("estop", "arm too low")]
    assert run(Script(refusal=True), "estop") == 1
    assert "failed: USE THE HARDWARE STOP" in capsys.readouterr().out


def test_watching_misses_no_event_of_a_burst(run, capsys):
    events = [{"number": n, "kind": "state", "text": f"event {n}"} for n in range(1, 6)]
    script = Script(
        [status(newest_event=1)],
        streams=[{"state": status(newest_event=2)}, {"state": status(newest_event=5)}, KeyboardInterrupt()],
        events=events,
    )
    assert run(script, "watch") == 130
    shown = [row.strip() for row in capsys.readouterr().out.splitlines() if "event" in row]
    assert shown == [f"state: event {n}" for n in range(2, 6)]


def test_watching_goes_on_after_a_restart_with_the_events_of_the_new_start(run, capsys):
    restarted = status(newest_event=1, boot="boot-2")
    script = Script(
        [status(newest_event=40), restarted],
        streams=[{}, {"state": restarted}, KeyboardInterrupt()],
        events=[{"number": 1, "kind": "state", "text": "event 1"}],
    )
    assert run(script, "watch", "--json") == 130
    assert script.subscribed == 2
    shown = [json.loads(row) for row in capsys.readouterr().out.splitlines()]
    assert [row["text"] for row in shown if "text" in row] == ["event 1"]


@pytest.mark.parametrize(
    ("words", "given"),
    [
        (["setup", "--policy-url", "ws://a:1"], ("setup", {"policy": {"url": "ws://a:1"}})),
        (["setup", "--task", "fold"], ("setup", {"task": "fold"})),
        (["run", "--duration", "2.5"], ("run", {"duration_s": 2.5})),
        (["run"], "run"),
    ],
)
def test_what_a_command_is_given_with_goes_along(run, words, given):
    script = Script([status()])
    assert run(script, *words) == 0
    assert script.given[0] == given


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["run", "--task", "fold"], "--task goes with setup, not with run"),
        (["stop", "--policy-url", "ws://a:1"], "--policy-url goes with setup, not with stop"),
        (["setup", "--duration", "3"], "--duration goes with run, not with setup"),
    ],
)
def test_an_option_of_another_command_is_an_error_before_anything_is_sent(run, capsys, words, says):
    script = Script([status()])
    with pytest.raises(SystemExit):
        run(script, *words)
    assert says in capsys.readouterr().err
    assert script.given == []
