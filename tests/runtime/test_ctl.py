import json
import os

import pytest

from runtime import ctl
from runtime.clients.client import Refused
from runtime.clients.terminal import wait_settled
from runtime.clients.terminal.keys import NoKeys
from runtime.core.errors import TransportError
from tests.runtime.terminal_station import AIM, Script, event, status


@pytest.fixture
def run(monkeypatch):
    """Runs a command line against a script; nobody is at the terminal, and waits take no time."""
    monkeypatch.setattr(wait_settled.time, "sleep", lambda _: None)
    monkeypatch.setattr("runtime.clients.terminal.command_follower.keys", NoKeys)
    monkeypatch.setenv("EVA_DATA_DIR", "/var/eva")

    def run(script, *words):
        monkeypatch.setattr(ctl, "StationClient", script)
        return ctl.main(["bench-1", *words])

    return run


def running(phase="waiting", step=0, **changes):
    control = {"lateness_p99_ms": 0.5, "missed": 0, "step": step, "behaviour": "follow"}
    return status("running", phase=phase, control=control, mode="step", **changes)


# --- where, and how it ends ----------------------------------------------------------------------------------


def test_the_station_is_looked_for_in_the_data_folder(run):
    script = Script()
    assert run(script, "status") == 0
    assert str(script.folder) == "/var/eva/stations/bench-1"
    assert script.closed
    run(script, "status", "--data-dir", "~/eva")
    assert "~" not in str(script.folder)


def test_a_refusal_is_told_and_is_no_success(run, capsys):
    assert run(Script(refusal=Refused("anna holds the lease")), "stop") == 1
    assert capsys.readouterr().err == "refused: anna holds the lease\n"


def test_no_answer_is_an_unknown_outcome_with_a_code_of_its_own(run, capsys):
    assert run(Script([TransportError("station 'bench-1' is not running here")]), "status") == 3
    assert capsys.readouterr().err == "error: station 'bench-1' is not running here\n"


def test_an_interrupted_terminal_says_so(run):
    assert run(Script([status()], streams=[KeyboardInterrupt()]), "watch") == 130


def test_a_pipe_that_nobody_reads_any_more_is_no_traceback(run, monkeypatch):
    read, written = os.pipe()
    os.close(read)
    with os.fdopen(written, "w") as pipe:
        monkeypatch.setattr("sys.stdout", pipe)
        assert run(Script([status()]), "status") == 141
        pipe.write("goes nowhere, and ends nothing")


# --- commands ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["stop", "halt", "step", "commit", "cancel"])
def test_a_short_command_is_given_and_the_state_shown(run, capsys, kind):
    script = Script()
    assert run(script, kind) == 0
    assert script.given == [kind]
    assert "READY" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "given"),
    [
        (["setup", "--policy-url", "ws://a:1"], ("setup", {"policy": {"url": "ws://a:1"}})),
        (["run", "--mode", "step"], ("run", {"mode": "step"})),
        (["run"], "run"),
        (["gripper", "open", "--arm", "left"], ("gripper", {"action": "open", "arm": "left"})),
        (["tune", "--strategy", "sync"], ("tune", {"strategy": {"kind": "sync"}})),
        (["move", "--pose", "home", "--speed", "0.5"], ("move", {"pose": "home", "speed": 0.5})),
        (["move", "--joint", "a+=0.1"], ("move", {"joints": [0.2, -0.2, 0.05]})),
        (["jog", "left", "--xyz", "0,0,10"], ("move", {"joints": AIM["joints"]})),
        (["record", "start"], "record_start"),
        (["record", "stop"], "record_stop"),
        (["approach"], "approach"),
        (["home"], "home"),
    ],
)
def test_what_a_command_is_given_with_goes_along(run, words, given):
    script = Script()
    assert run(script, *words) == 0
    assert script.given == [given]


@pytest.mark.parametrize(
    ("kind", "while_", "end", "code"),
    [
        ("setup", "setting_up", "ready", 0),
        ("setup", "setting_up", "idle", 1),  # it failed
        ("run", "running", "ready", 0),
        ("run", "running", "holding", 1),
        ("run", "running", "faulted", 1),
        ("resume", "running", "ready", 0),
        ("approach", "setting_up", "idle", 1),
    ],
)
def test_the_end_of_a_lasting_command_is_the_exit_code(run, capsys, kind, while_, end, code):
    first = [status("ready")] if kind == "approach" else []
    assert run(Script([*first, status(while_), status(end, reason="over")]), kind) == code
    assert capsys.readouterr().err == (f"failed: {end}, over\n" if code else "")


def test_a_set_up_can_be_cancelled_and_only_a_set_up(run, capsys):
    script = Script([status("setting_up"), status("setting_up"), status("idle")])
    assert run(script, "setup", "--cancel") == 0
    assert script.given == ["stop"]
    script = Script([running()])
    assert run(script, "setup", "--cancel") == 1
    assert script.given == []
    assert "no set-up to cancel: the station is running" in capsys.readouterr().err


def test_released_is_what_was_released(run, capsys):
    script = Script([status("faulted"), status("idle")])
    assert run(script, "release") == 0
    assert script.given == ["release"]
    assert "IDLE" in capsys.readouterr().out


def test_the_estop_says_whether_it_was_obeyed(run, capsys):
    script = Script()
    assert run(script, "estop", "arm too low") == 0
    assert script.given == [("estop", "arm too low")]
    assert run(Script(refusal=Refused("no guard")), "estop", "--json") == 1
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["reason"] == "USE THE HARDWARE STOP"


# --- waiting -------------------------------------------------------------------------------------------------


def test_a_script_waits_for_the_end_of_what_it_asked_for(run, capsys):
    steps = [running(step=1), running("asking", 2), running("executing", 3, newest_event=2)]
    script = Script(
        [*steps, running("waiting", 4, newest_event=2), running("waiting", 9, newest_event=2)],
        events=[event(1, "command", "step by me"), event(2, "limited", "safety slowed joint a")],
    )
    assert run(script, "step", "--wait") == 0
    shown = capsys.readouterr().out
    assert "  limited: safety slowed joint a\n" in shown
    assert "step by me" not in shown
    assert "RUNNING (step, waiting)" in shown


@pytest.mark.parametrize(
    ("words", "last", "says"),
    [
        (["step"], status("holding", reason="policy lost"), "running no longer: holding, policy lost"),
        (["move", "--pose", "home"], running("waiting", 9), "it ended early"),
    ],
)
def test_what_went_wrong_meanwhile_is_no_success(run, capsys, words, last, says):
    before = [running(step=1), running("asking", 2), running("waiting", 3)]
    assert run(Script([*before, last]), *words, "--wait") == 1
    assert says in capsys.readouterr().err


def test_an_approach_within_a_run_waits_for_its_arrival(run):
    before = [
        running("proposed", 1),
        running("proposed", 1),
        running("approaching", 2),
        running("proposed", 3),
    ]
    script = Script([*before, running("proposed", 9, newest_event=1)])
    script.events = [event(1, "motion_done", "arrived")]
    assert run(script, "approach", "--wait") == 0
    assert script.given[0] == "approach"


def test_a_script_waits_for_a_state_or_for_a_phase(run):
    script = Script([status("setting_up"), status("ready"), running("asking")])
    assert run(script, "wait", "ready") == 0
    assert run(script, "wait", "asking", "--timeout", "2") == 0
    assert script.given == []


# --- aims ----------------------------------------------------------------------------------------------------


def test_an_aim_says_where_it_would_go_and_moves_nothing(run, capsys):
    there = AIM | {"joints": [0.5, -0.2, 0.05]}
    script = Script(aims=[there])
    assert run(script, "aim", "--arm", "left", "--xyz", "10,0,0") == 0
    assert script.given == []
    assert "a                        +0.1000 -> +0.5000" in capsys.readouterr().out
    assert run(Script(aims=[there]), "aim", "--pose", "home", "--json") == 0
    assert json.loads(capsys.readouterr().out) == there


def test_a_jog_that_cannot_arrive_is_not_begun_unless_the_nearest_will_do(run, capsys):
    short = AIM | {"reached": False, "position_error_mm": 30.0, "rotation_error_deg": 1.0}
    script = Script(aims=[short, short])
    assert run(script, "jog", "left", "--xyz", "900,0,0") == 1
    assert script.given == []
    assert "refused: it cannot go there: 30.0 mm and 1.0 degrees away" in capsys.readouterr().err
    assert run(script, "jog", "left", "--xyz", "900,0,0", "--nearest", "--speed", "0.2") == 0
    assert script.given == [("move", {"joints": AIM["joints"], "speed": 0.2})]


def test_an_aim_that_misses_is_no_success(run):
    assert run(Script(aims=[AIM | {"clipped": ["b"]}]), "aim", "--pose", "home") == 1


# --- what is shown -------------------------------------------------------------------------------------------


def test_a_status_is_a_page_or_json(run, capsys):
    run(Script(), "status")
    shown = capsys.readouterr().out.splitlines()
    assert shown[0] == "READY: set up  tick p99 0.50 ms, 2 missed"
    assert "  drives    not reported by the node" in shown
    run(Script(), "status", "--json")
    assert json.loads(capsys.readouterr().out)["state"] == "ready"


def test_every_outcome_can_be_had_as_json(run, capsys):
    run(Script([status()]), "halt", "--json")
    assert json.loads(capsys.readouterr().out)["state"] == "ready"
    run(Script([running(), running(), status()]), "run", "--json")
    assert json.loads(capsys.readouterr().out)["state"] == "ready"
    steps = [running(step=1), *[running("waiting", step, newest_event=1) for step in (1, 9)]]
    run(Script(steps, events=[event(1)]), "step", "--wait", "--json")
    assert json.loads(capsys.readouterr().out)["phase"] == "waiting"


def test_a_tuning_is_shown_with_and_without_a_change(run, capsys):
    script = Script()
    assert run(script, "tune", "--show") == 0
    assert script.given == []
    assert "ensemble_m 0.01 (nothing to async)" in capsys.readouterr().out
    assert run(script, "tune", "--task", "stack", "--json") == 0
    assert script.given == [("tune", {"task": "stack"})]
    assert json.loads(capsys.readouterr().out)["strategy"]["kind"] == "async"


def test_events_are_listed(run, capsys):
    assert run(Script(events=[event(1, "drives", "drives disabled")]), "events") == 0
    assert "drives: drives disabled" in capsys.readouterr().out
