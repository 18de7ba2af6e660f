"""What each state says: the questions that clients ask, and that they never contradict each other."""

from __future__ import annotations

import pytest

from runtime.ipc.session_state import MEANINGS, SessionState, complete_state_meaning

S = SessionState


@pytest.mark.parametrize(
    ("question", "states"),
    [
        ("connected", set(S) - {S.DISCONNECTED}),
        ("preparing", {S.SETTING_UP}),
        ("set_up", {S.READY, S.RUNNING, S.HOLDING}),
        ("run_open", {S.RUNNING, S.HOLDING}),
        ("moving", {S.SETTING_UP, S.RUNNING}),
        ("latched", {S.FAULTED}),
        ("at_work", {S.SETTING_UP, S.RUNNING, S.HOLDING}),
        ("idle", {S.IDLE}),
        ("ready", {S.READY}),
        ("going", {S.RUNNING}),
        ("held", {S.HOLDING}),
    ],
)
def test_a_question_is_answered_by_the_rows_alone(question: str, states: set[SessionState]) -> None:
    assert {state for state in S if state.meaning_dict()[question]} == states


def test_every_state_has_a_row_and_a_snapshot_has_all_of_it() -> None:
    assert set(MEANINGS) == set(S)
    told = S.SETTING_UP.meaning_dict()
    assert (told["label"], told["tone"]) == ("setting up", "active")
    assert set(told) == set(S.IDLE.meaning_dict())


def test_a_word_that_is_no_state_means_nothing() -> None:
    assert SessionState.meaning_of("holding") is S.HOLDING.meaning
    assert SessionState.meaning_of("dancing") is None


@pytest.mark.parametrize("state", S)
def test_a_station_that_was_started_before_an_upgrade_says_as_much_as_one_of_today(
    state: SessionState,
) -> None:
    assert complete_state_meaning({"state": str(state), "reason": "so"}) == {
        "state": str(state),
        "reason": "so",
        "state_is": state.meaning_dict(),
    }


def test_what_a_station_says_of_its_state_stands_and_what_it_leaves_out_follows_from_it() -> None:
    said = {"label": "on the move", "tone": "active", "run_open": True, "moving": True, "asleep": False}
    found = complete_state_meaning({"state": "calibrating", "state_is": said})["state_is"]
    assert found == {**MEANINGS[S.IDLE].to_dict(), **said, "at_work": True, "idle": False, "going": True}


def test_a_state_that_is_not_known_is_neutral_and_not_idle() -> None:
    assert complete_state_meaning({"state": "parked_by_night"})["state_is"] == {
        **S.IDLE.meaning_dict(),
        "label": "parked by night",
        "idle": False,
    }
