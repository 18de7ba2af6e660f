"""What a person is told of the class that control got, and of late ticks."""

from __future__ import annotations

import numpy as np
import pytest

from runtime.ipc.shared_state import SharedState, SharedStateLayout
from runtime.processes.coordinator.timing_report import TimingReport


@pytest.fixture
def shared() -> SharedState:
    shared, _ = SharedState.create(SharedStateLayout(dim=2, eef_dim=8, cameras=(), picture_bytes=16))
    return shared


def tell(shared: SharedState, scheduling: str, p99_ms: float = 0.1, ticks: int = 1000) -> None:
    status = np.zeros((), shared.layout.control_dtype())
    status["scheduling"], status["ticks"], status["lateness_p99"] = scheduling.encode(), ticks, p99_ms / 1000
    shared.control.write(status)


def watching(shared: SharedState, asked: bool = True) -> TimingReport:
    return TimingReport(shared, 100.0, 20, asked)


def kinds(punctuality: TimingReport, now: float) -> list[str]:
    return [event.kind for event in punctuality.poll(now)]


def test_who_has_the_real_time_class_and_is_on_time_is_told_nothing(shared: SharedState) -> None:
    tell(shared, "FIFO 20")
    assert watching(shared).poll(10.0) == []


def test_another_class_is_told_once_with_what_to_do_about_it(shared: SharedState) -> None:
    tell(shared, "slice 0.1 ms unlocked")
    told = watching(shared)
    (event,) = told.poll(10.0)
    assert event.kind == "scheduling"
    assert "'slice 0.1 ms unlocked'" in event.text
    assert "rtprio limit of 20" in event.text
    assert "LimitRTPRIO=20" in event.text
    assert told.poll(12.0) == []


def test_who_did_not_ask_for_the_class_gets_no_advice(shared: SharedState) -> None:
    tell(shared, "ordinary")
    assert watching(shared, asked=False).poll(10.0) == []


def test_late_ticks_are_told_once_and_once_again_when_they_are_over(shared: SharedState) -> None:
    told = watching(shared)
    heard = []
    for now, p99_ms in enumerate((0.2, 1.4, 3.0, 0.8, 0.4, 0.4), start=10):
        tell(shared, "FIFO 20", p99_ms)
        heard.append(kinds(told, float(now)))
    assert heard == [[], ["late_ticks"], [], [], ["punctual"], []]


def test_nothing_is_judged_before_two_seconds_of_ticks_nor_without_a_clock_of_its_own(
    shared: SharedState,
) -> None:
    told = watching(shared)
    tell(shared, "ordinary", 5.0, ticks=199)
    assert told.poll(10.0) == []
    tell(shared, "", 5.0)  # lockstep
    assert told.poll(12.0) == []
    tell(shared, "ordinary", 5.0, ticks=200)
    assert kinds(told, 14.0) == ["scheduling", "late_ticks"]


def test_it_looks_once_a_second(shared: SharedState) -> None:
    told = watching(shared)
    assert told.poll(10.0) == []
    tell(shared, "ordinary", 5.0)
    assert told.poll(10.9) == []
    assert kinds(told, 11.0) == ["scheduling", "late_ticks"]
