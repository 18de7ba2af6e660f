import pytest

from runtime.clients.channel.outcomes import KEPT, Outcome, Outcomes, is_long_running
from tests.runtime.terminal_station import event, status


def given(kind, state="running", **before):
    return Outcome("id", kind, kind, "accepted", before=status(state, **before))


def ticking(state, step, phase="waiting", **changes):
    control = {"step": step, "behaviour": "follow"}
    return status(state, phase=phase, control=control, **changes)


def none_since(number):
    return []


@pytest.mark.parametrize(
    "kind", ["setup", "run", "resume", "home", "approach", "step", "commit", "move", "gripper"]
)
def test_these_go_on_after_they_were_accepted(kind):
    assert is_long_running(kind)


@pytest.mark.parametrize("kind", ["stop", "halt", "tune", "release", "record_start", "record_stop"])
def test_these_are_done_at_once(kind):
    assert not is_long_running(kind)


@pytest.mark.parametrize(
    ("kind", "states", "result"),
    [
        ("setup", ["setting_up", "ready"], "done"),
        ("setup", ["setting_up", "idle"], "failed"),
        ("home", ["ready"], "done"),
        ("run", ["running", "running", "ready"], "done"),
        ("run", ["running", "holding"], "failed"),
        ("resume", ["faulted"], "failed"),
        ("run", ["running"], "accepted"),
    ],
)
def test_what_has_a_state_of_its_own_is_over_when_that_is_left(kind, states, result):
    outcome = given(kind, "ready")
    for state in states:
        outcome.poll(status(state, reason="because"), none_since)
    assert outcome.result == result
    assert ("because" in outcome.reason) == (result != "accepted")


def test_a_step_is_done_when_the_robot_stands_for_some_ticks():
    outcome = given("step")
    for step, phase in ((0, "asking"), (5, "executing"), (9, "executing"), (15, "waiting"), (17, "waiting")):
        outcome.poll(ticking("running", step, phase), none_since)
        assert outcome.result == "accepted"
    outcome.poll(ticking("running", 18), none_since)
    assert (outcome.result, outcome.reason) == ("done", "")


def test_a_move_that_was_over_between_two_looks_is_not_failed_before_its_end_is_told():
    outcome = given("move")
    told = [event(1, "motion_done")]
    outcome.poll(ticking("running", 0), none_since)  # it has not begun
    outcome.poll(ticking("running", 30), none_since)  # it has ended at this tick
    assert outcome.result == "accepted"
    outcome.poll(ticking("running", 33, newest_event=1), lambda number: told)
    assert outcome.result == "done"


def test_a_step_whose_chunk_was_dropped_has_failed_with_the_reason():
    outcome = given("step")
    dropped = [event(1, "chunk_dropped", "chunk 4 dropped: too late")]
    outcome.poll(ticking("running", 1, newest_event=1), lambda number: dropped if number < 1 else [])
    outcome.poll(ticking("running", 9, newest_event=1), none_since)
    outcome.poll(ticking("running", 12, newest_event=1), none_since)
    assert (outcome.result, outcome.reason) == ("failed", "chunk 4 dropped: too late")


@pytest.mark.parametrize(("events", "result"), [([event(1, "motion_done")], "done"), ([], "failed")])
def test_a_move_is_done_when_the_motion_was_told_to_be(events, result):
    outcome = given("move")
    outcome.poll(ticking("running", 1, "moving"), none_since)
    outcome.poll(ticking("running", 2, newest_event=len(events)), lambda number: events)
    outcome.poll(ticking("running", 9, newest_event=len(events)), none_since)
    outcome.poll(ticking("running", 12, newest_event=len(events)), none_since)
    assert outcome.result == result


def test_what_a_stop_has_ended_has_failed():
    outcome = given("move")
    outcome.poll(ticking("holding", 1), none_since)
    assert outcome.result == "failed"
    assert "holding" in outcome.reason


def test_after_a_restart_of_the_station_it_is_not_known():
    outcome = given("run", "ready")
    outcome.poll(status("idle", boot="boot-2"), none_since)
    assert (outcome.result, outcome.reason) == ("unknown", "the station was restarted")


def test_the_first_outcome_of_an_id_stays_unless_it_is_unknown():
    outcomes = Outcomes()
    outcomes.add(Outcome("a", "run", "run", "unknown"))
    outcomes.add(Outcome("a", "run", "run", "accepted"))
    outcomes.add(Outcome("a", "run", "run", "refused"))
    assert outcomes.get("a").result == "accepted"
    assert [outcome.id for outcome in outcomes.pending] == ["a"]


def test_only_the_newest_are_remembered():
    outcomes = Outcomes()
    for number in range(KEPT + 5):
        outcomes.add(Outcome(str(number), "stop", "stop", "done"))
    assert outcomes.get("4") is None
    assert outcomes.get("5") is not None
