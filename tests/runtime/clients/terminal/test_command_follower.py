import contextlib
import signal

import pytest

from runtime.clients.client import Refused
from runtime.clients.terminal import command_follower
from runtime.clients.terminal.command_follower import follow_command
from runtime.clients.terminal.keys import Keys, NoKeys
from tests.runtime.terminal_station import Script, status


class Person(Keys):
    """Presses one key after the other, then none."""

    def __init__(self, pressed):
        self.pressed, self.left = list(pressed), False

    def key(self, seconds):
        return self.pressed.pop(0) if self.pressed else ""

    def __enter__(self):
        return self

    def __exit__(self, *of):
        self.left = True


@pytest.fixture(autouse=True)
def at_the_terminal(monkeypatch):
    """Nobody, or who the test sets there; waits take no time."""
    there = {"keys": NoKeys()}
    monkeypatch.setattr("runtime.clients.terminal.keys.time.sleep", lambda _: None)
    monkeypatch.setattr(command_follower, "keys", lambda: there["keys"])
    return there


@pytest.mark.parametrize(
    ("kind", "while_", "end"),
    [
        ("setup", "setting_up", "ready"),
        ("setup", "setting_up", "idle"),
        ("home", "setting_up", "ready"),
        ("approach", "setting_up", "ready"),
        ("run", "running", "holding"),
        ("resume", "running", "ready"),
    ],
)
def test_it_stays_until_the_end_and_keeps_the_lease(kind, while_, end):
    script = Script([status(while_), status(while_), status(end)])
    assert follow_command(script, kind, {"task": "fold"}, print)["state"] == end
    assert script.given == [(kind, {"task": "fold"}), "renew", "renew"]


def test_ctrl_c_stops_what_was_begun():
    before = signal.getsignal(signal.SIGINT)
    script = Script([status("running"), KeyboardInterrupt(), status("ready")])
    assert follow_command(script, "run", {}, print)["state"] == "ready"
    assert script.given == ["run", "renew", "stop"]
    assert signal.getsignal(signal.SIGINT) is before


def test_a_signal_stops_it_wherever_it_comes():
    script = Script([status("running")])
    renew = script.renew

    def signalled():
        renew()
        signal.raise_signal(signal.SIGINT)

    script.renew = signalled
    script.command = lambda kind: (
        script.given.append(kind) or (kind == "stop" and script.statuses.__setitem__(0, status("ready")))
    )
    assert follow_command(script, "run", {}, print)["state"] == "ready"
    assert script.given == ["run", "renew", "stop"]


def test_ctrl_c_before_the_answer_stops_too():
    script = Script([status("ready")], KeyboardInterrupt())

    def interrupted_once(kind):
        refusal, script.refusal = script.refusal, None
        script.given.append(kind)
        if refusal:
            raise refusal

    script.command = interrupted_once
    follow_command(script, "run", {}, print)
    assert script.given == ["run", "stop"]


def keyed(mode, phase="waiting", **changes):
    return status("running", mode=mode, phase=phase, **changes)


@pytest.mark.parametrize("mode", ["step", "preview", "manual"])
def test_a_person_at_the_terminal_has_keys(at_the_terminal, capsys, mode):
    person = at_the_terminal["keys"] = Person("\nc?xq")
    script = Script([*[keyed(mode)] * 6, status("ready")])
    follow_command(script, "run", {}, print)
    assert [given for given in script.given if given != "renew"] == [
        "run",
        "step",
        "commit",
        "cancel",
        "stop",
    ]
    assert person.left
    assert "q: stop" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("kind", "mode", "state"), [("run", "continuous", "running"), ("setup", "step", "setting_up")]
)
def test_what_needs_no_person_takes_no_keys(at_the_terminal, kind, mode, state):
    at_the_terminal["keys"] = Person("qqq")
    script = Script([status(state, mode=mode), status("ready")])
    follow_command(script, kind, {}, print)
    assert script.given == [kind, "renew"]


def test_a_key_that_is_refused_is_told_and_the_run_goes_on(at_the_terminal, capsys):
    at_the_terminal["keys"] = Person("c")
    script = Script([keyed("step")] * 2 + [status("ready")])
    give = script.command

    def refuse(kind, **arguments):
        give(kind, **arguments)
        if kind == "commit":
            raise Refused("commit is for preview")

    script.command = refuse
    assert follow_command(script, "run", {}, print)["state"] == "ready"
    assert capsys.readouterr().err == "refused: commit is for preview\n"


def test_with_keys_a_line_comes_when_something_else_goes_on_and_says_the_keys(at_the_terminal, capsys):
    at_the_terminal["keys"] = Person("")
    proposal = {"chunk": 3, "distance": 0.1, "joint": "a", "far": False}
    script = Script(
        [
            *[keyed("preview")] * 3,
            *[keyed("preview", "asking")] * 3,
            *[keyed("preview", "proposed", proposal=proposal)] * 2,
            status("ready"),
        ]
    )
    follow_command(script, "run", {}, print)
    told = capsys.readouterr().out.splitlines()
    assert [row.split("  ")[0] for row in told if row.startswith("RUNNING")] == [
        "RUNNING (preview, waiting): set up",
        "RUNNING (preview, asking): set up",
        "RUNNING (preview, proposed): set up",
    ]
    assert told[1].strip() == "[Enter: next chunk, c: commit, x: cancel, q: stop]"
    assert told[-1].strip().startswith("the chunk that is shown is 0.100 rad away (a)  [Enter")


def test_the_terminal_is_left_also_when_the_station_is_gone(at_the_terminal):
    person = at_the_terminal["keys"] = Person("")
    script = Script([keyed("step"), ConnectionError("gone")])
    with contextlib.suppress(ConnectionError):
        follow_command(script, "run", {}, print)
    assert person.left
