import pytest

from runtime.clients.terminal import wait_settled
from runtime.clients.terminal.wait_settled import wait_until_settled
from tests.runtime.terminal_station import Script, event, status


@pytest.fixture(autouse=True)
def no_sleep(monkeypatch):
    monkeypatch.setattr(wait_settled.time, "sleep", lambda _: None)


def running(phase, step, state="running", behaviour="follow", **changes):
    control = {"lateness_p99_ms": 0.5, "missed": 0, "step": step, "behaviour": behaviour}
    return status(state, phase=phase, control=control, **changes)


def settled(*statuses, events=()):
    script, told = Script(statuses, events=events), []
    return (
        wait_until_settled(script, {"state": statuses[0]["state"], "newest_event": 0}, told.append),
        told,
        script,
    )


def test_it_is_over_when_the_run_has_waited_for_a_few_ticks():
    found, told, script = settled(
        running("waiting", 10),  # what was asked for has not come to control
        running("asking", 11),
        running("executing", 12),
        running("waiting", 13),
        running("waiting", 14),
        running("waiting", 16),
    )
    assert found.status["control"]["step"] == 16
    assert found.failure() == ""
    assert "renew" in script.given
    assert told == []


def test_a_pause_between_two_looks_that_are_many_ticks_apart_is_not_the_end():
    """At 200 Hz four ticks pass between two looks: a motion may be over without its end being told yet."""
    told = event(1, "motion_done")
    found, _, _ = settled(
        running("moving", 10),
        running("waiting", 14),
        running("waiting", 18, newest_event=1),
        events=[told],
    )
    assert found.failure("motion_done") == ""


def test_what_was_over_at_once_is_over_after_a_few_ticks():
    found, _, _ = settled(*[running("waiting", 10)] * 3, running("waiting", 13))
    assert found.failure() == ""


def test_a_chunk_that_is_shown_is_the_end_of_a_step():
    found, _, _ = settled(running("asking", 10), running("proposed", 11), running("proposed", 14))
    assert found.status["phase"] == "proposed"


def test_a_run_that_does_not_go_on_is_a_failure_with_its_reason():
    found, _, _ = settled(running("asking", 10), status("holding", reason="policy lost"))
    assert found.failure() == "running no longer: holding, policy lost"


def test_events_are_told_as_they_come_and_a_dropped_chunk_is_a_failure():
    dropped = event(7, "chunk_dropped", "chunk 3 dropped: old")
    found, told, _ = settled(
        running("asking", 10, newest_event=6),
        running("waiting", 11, newest_event=7),
        running("waiting", 14, newest_event=7),
        events=[event(6), dropped],
    )
    assert told == [event(6), dropped]
    assert found.failure() == "chunk 3 dropped: old"


def test_a_motion_that_did_not_arrive_is_a_failure():
    ended = [running("moving", 10), running("waiting", 11), running("waiting", 14, newest_event=1)]
    found, _, _ = settled(*ended, events=[event(1, "command")])
    assert found.failure("motion_done") == "it ended early (motion_done was not reported)"
    found, _, _ = settled(*ended, events=[event(1, "motion_done")])
    assert found.failure("motion_done") == ""


def test_a_gripper_is_waited_for_where_no_run_is_open():
    found, _, _ = settled(
        running("", 10, "ready", "hold"),
        running("", 11, "ready", "motion"),
        running("", 14, "ready", "motion"),
        running("", 15, "ready", "hold"),
        running("", 18, "ready", "hold"),
    )
    assert found.status["control"]["step"] == 18
    assert found.failure() == ""
