import json

import pytest

from runtime.clients.terminal import watch
from runtime.clients.terminal.syntax import parse
from tests.runtime.terminal_station import Script, event, status


def test_watching_misses_no_event_of_a_burst(capsys):
    script = Script(
        [status(newest_event=1)],
        streams=[{"state": status(newest_event=2)}, {"state": status(newest_event=5)}, KeyboardInterrupt()],
        events=[event(n) for n in range(1, 6)],
    )
    with pytest.raises(KeyboardInterrupt):
        watch.watch(script, False)
    shown = [row.strip() for row in capsys.readouterr().out.splitlines() if "event" in row]
    assert shown == [f"state: event {n}" for n in range(2, 6)]


def test_watching_goes_on_after_a_restart_with_the_events_of_the_new_start(capsys):
    restarted = status(newest_event=1, boot="boot-2")
    script = Script(
        [status(newest_event=40), restarted],
        streams=[{}, {"state": restarted}, KeyboardInterrupt()],
        events=[event(1)],
    )
    with pytest.raises(KeyboardInterrupt):
        watch.watch(script, True)
    assert script.subscribed == 2
    shown = [json.loads(row) for row in capsys.readouterr().out.splitlines()]
    assert [row["text"] for row in shown if "text" in row] == ["event 1"]


def test_a_station_that_was_started_before_an_upgrade_is_watched(capsys):
    old = {key: value for key, value in status("running").items() if key != "state_is"}
    with pytest.raises(KeyboardInterrupt):
        watch.watch(Script(streams=[{"state": old}, KeyboardInterrupt()]), False)
    assert capsys.readouterr().out.startswith("RUNNING (continuous): set up")


def test_a_lease_is_named_where_somebody_else_holds_it(capsys):
    theirs = status(lease={"holder": "anna", "expires_in": 1.0})
    with pytest.raises(KeyboardInterrupt):
        watch.watch(Script([theirs], streams=[{"state": theirs}, KeyboardInterrupt()]), False)
    assert capsys.readouterr().out.endswith("  lease: anna\n")


@pytest.mark.parametrize(
    ("words", "numbers"),
    [
        ([], [1, 2, 3, 4]),
        (["--since", "2"], [3, 4]),
        (["--last", "1"], [4]),
        (["--last", "9"], [1, 2, 3, 4]),
        (["--kind", "drives", "--last", "1"], [3]),
    ],
)
def test_events_are_listed(capsys, words, numbers):
    events = [event(1), event(2, "drives"), event(3, "drives"), event(4)]
    script = Script(events=events)
    assert watch.list_events(script, parse(["bench-1", "events", *words, "--json"])) == 0
    assert [json.loads(row)["number"] for row in capsys.readouterr().out.splitlines()] == numbers


def test_an_event_in_a_list_says_how_long_ago_it_was(capsys):
    watch.list_events(Script(events=[event(12, "drives", "drives disabled")]), parse(["b", "events"]))
    assert capsys.readouterr().out == "    12     10.0 s ago  drives: drives disabled\n"
