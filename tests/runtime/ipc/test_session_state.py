"""What each state says: the questions that clients ask, and that they never contradict each other."""

from __future__ import annotations

import pytest

from runtime.ipc.session_state import MEANINGS, SessionState

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
    assert {state for state in S if state.told()[question]} == states


def test_every_state_has_a_row_and_a_snapshot_has_all_of_it() -> None:
    assert set(MEANINGS) == set(S)
    told = S.SETTING_UP.told()
    assert (told["label"], told["tone"]) == ("setting up", "active")
    assert set(told) == set(S.IDLE.told())


def test_a_word_that_is_no_state_means_nothing() -> None:
    assert SessionState.of("holding") is S.HOLDING.meaning
    assert SessionState.of("dancing") is None
