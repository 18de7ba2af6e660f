from __future__ import annotations

import pytest

from runtime.core import realtime
from runtime.ipc.messages import BeginRun, Event, Observed, ReceptionReport, RunBegun, decode, encode
from runtime.processes.reception.process import CpuShare, Reception
from tests.runtime.processes.media.test_media_process import CAMERAS, Desk


@pytest.fixture
def desk() -> Desk:
    return Desk()


def handed_on(desk: Desk) -> list[object]:
    return [decode(payload) for payload in desk.shared.rings["observations"].drain()]


def test_the_first_frame_of_a_run_is_handed_on_before_it_is_said_to_have_begun(desk: Desk) -> None:
    desk.source.first = desk.observation(1)
    desk.shared.rings["source"].push(encode(BeginRun(7)))
    assert desk.reception.poll_commands()
    observed, begun = handed_on(desk)
    assert isinstance(observed, Observed)
    assert (observed.sequence, observed.pictures) == (1, dict.fromkeys(CAMERAS, 1))
    assert begun == RunBegun(7)
    assert not desk.reception.poll_commands()


def test_that_a_run_has_begun_is_said_as_soon_as_there_is_room(desk: Desk) -> None:
    push = desk.shared.rings["observations"].push
    desk.shared.rings["observations"].push = lambda payload: False  # type: ignore[method-assign]
    desk.shared.rings["source"].push(encode(BeginRun(7)))
    assert not desk.reception.poll_commands()
    desk.shared.rings["observations"].push = push  # type: ignore[method-assign]
    assert desk.reception.poll_commands()
    assert handed_on(desk) == [RunBegun(7)]
    assert desk.source.begun == 1


def test_what_was_asked_of_a_predecessor_is_not_done(desk: Desk) -> None:
    desk.shared.rings["source"].push(encode(BeginRun(7)))
    Reception(desk.shared, desk.source, desk.clock).poll(0.0)
    assert desk.source.begun == 0


def test_it_reports_how_old_joints_come_in_and_as_what_it_runs(desk: Desk) -> None:
    desk.reception = Reception(desk.shared, desk.source, desk.clock, "FIFO 19")
    desk.source.waiting.append(desk.observation(1, captured={"joints": desk.clock.now() - 0.02}))
    desk.reception.poll(0.0)
    (report,) = desk.told(ReceptionReport)
    assert report.scheduling == "FIFO 19"
    assert report.age_ms == pytest.approx(dict.fromkeys(("p50", "p99", "max"), 20.0))


def test_it_reports_and_obeys_also_while_its_source_is_not_there(desk: Desk) -> None:
    desk.source.counts = {"malformed": 1}
    desk.shared.rings["source"].push(encode(BeginRun(7)))
    desk.reception.poll_disconnected()
    (report,) = desk.told(ReceptionReport)
    assert report.faults == {"malformed": 1}
    assert RunBegun(7) in handed_on(desk)


def test_more_than_a_core_for_seconds_is_too_much_and_a_moment_of_it_is_not() -> None:
    share = CpuShare()
    taken = [0.0, 0.9, 1.8, 2.7, 4.7, 6.7, 8.8]
    assert [share.exceeds_core(float(now), used) for now, used in enumerate(taken)] == [False] * 6 + [True]


def test_it_gives_its_class_up_with_a_sentence(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    left: list[str] = []
    monkeypatch.setattr(realtime, "leave_realtime_all", lambda: left.append("all"))
    desk.reception = Reception(desk.shared, desk.source, desk.clock, "FIFO 19")
    desk.reception.leave_realtime()
    desk.reception.report()
    said, report = desk.heard()
    assert isinstance(said, Event)
    assert (said.kind, "gives its real-time class up" in said.text) == ("scheduling", True)
    assert isinstance(report, ReceptionReport)
    assert (report.scheduling, left) == ("ordinary", ["all"])
