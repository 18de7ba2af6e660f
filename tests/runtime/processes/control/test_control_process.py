"""The loop around the tick: absolute deadlines, missed ticks, and what it says of its lateness."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runtime.core.clock import VirtualClock
from runtime.ipc.messages import ExecutedTick, Order, PostedChunk, decode, encode
from runtime.ipc.shared_state import EStop, SharedState, SharedStateLayout
from runtime.processes.control.process import Lateness, Loop, make_tick
from tests.runtime import lockstep_station as station
from tests.runtime.lockstep_station import STANDS
from tests.runtime.tick_bench import RecordingSink


class LateClock(VirtualClock):
    """Each sleep ends so much too late as `late` says next; 0 where it says nothing."""

    def __init__(self, *late: float) -> None:
        super().__init__(100.0)
        self._late = list(late)

    def sleep_until(self, deadline: float) -> None:
        super().sleep_until(deadline)
        self.advance(self._late.pop(0) if self._late else 0.0)


class Ticks:
    """In the place of the tick: keeps what it was called with."""

    def __init__(self, shared: SharedState) -> None:
        self.status = np.zeros((), shared.layout.control_dtype())
        self.done: list[tuple[int, float, float]] = []

    def __call__(self, step: int, planned: float, woke: float) -> None:
        self.done.append((step, planned, woke))


@pytest.fixture
def shared() -> SharedState:
    shared, _ = SharedState.create(SharedStateLayout(dim=2, eef_dim=8, cameras=(), picture_bytes=16))
    return shared


def looped(shared: SharedState, clock: VirtualClock, times: int, rate: float = 10.0) -> Ticks:
    ticks: Any = Ticks(shared)
    loop = Loop(ticks, shared, clock, rate, "FIFO 20")
    for _ in range(times):
        loop.tick_once()
    return ticks


def test_a_late_tick_does_not_make_the_next_one_late(shared: SharedState) -> None:
    done = looped(shared, LateClock(0.0, 0.03, 0.0), 3).done
    assert [step for step, _, _ in done] == [1, 2, 3]
    assert [planned for _, planned, _ in done] == pytest.approx([100.1, 100.2, 100.3])
    assert [woke - planned for _, planned, woke in done] == pytest.approx([0.0, 0.03, 0.0])


def test_missed_ticks_are_skipped_and_counted_and_steps_follow_the_clock(shared: SharedState) -> None:
    ticks = looped(shared, LateClock(0.0, 0.25, 0.0), 3)
    assert [step for step, _, _ in ticks.done] == [1, 4, 5]
    assert [planned for _, planned, _ in ticks.done] == pytest.approx([100.1, 100.4, 100.5])
    assert [woke - planned for _, planned, woke in ticks.done] == pytest.approx([0.0, 0.05, 0.0])


def test_the_rate_is_exact_however_late_each_tick_is(shared: SharedState) -> None:
    done = looped(shared, LateClock(*[0.001, 0.004] * 500), 1000, rate=200.0).done
    assert done[-1][1] - done[0][1] == pytest.approx(999 / 200.0)


def test_its_figures_are_those_of_the_newest_ticks_and_counters_go_on() -> None:
    status = np.zeros((), SharedStateLayout(dim=2, eef_dim=8, cameras=(), picture_bytes=16).control_dtype())
    status["ticks"], status["missed"] = 50, 2
    lateness = Lateness(status, "FIFO 20")
    lateness.write()
    assert status["lateness_p99"] == 0.0
    for _ in range(2000):
        lateness.add(9.0, 0)
    for _ in range(1980):
        lateness.add(0.001, 0)
    for _ in range(20):
        lateness.add(0.5, 1)
    lateness.write()
    assert (int(status["ticks"]), int(status["missed"])) == (4050, 22)
    assert float(status["lateness_p50"]) == pytest.approx(0.001)
    assert float(status["lateness_p999"]) == pytest.approx(0.5)
    assert float(status["lateness_max"]) == pytest.approx(0.5)
    assert status["scheduling"] == b"FIFO 20"


class Beats:
    """In the place of the tick: looks when control last said that it is alive."""

    def __init__(self, shared: SharedState) -> None:
        self.status = np.zeros((), shared.layout.control_dtype())
        self._shared_state = shared
        self.seen: list[float] = []

    def __call__(self, step: int, planned: float, woke: float) -> None:
        self.seen.append(self._shared_state.last_beat("control"))


def test_control_is_alive_in_the_page_before_its_tick_begins(shared: SharedState) -> None:
    beats: Any = Beats(shared)
    Loop(beats, shared, LateClock(0.002), 10.0, "ordinary").tick_once()
    assert beats.seen == pytest.approx([100.102])


@pytest.mark.parametrize(("half", "refused"), [(2.0, False), (0.05, True)])
def test_the_tick_of_a_deployment_keeps_its_arms_in_their_boxes(
    tmp_path: Path, half: float, refused: bool
) -> None:
    box = {"lower": [-half] * 3, "upper": [half] * 3}
    stubs = station.stubbed(tmp_path, safety={"workspace": {"left_arm": box}})
    spec = stubs.spec
    shared, _ = SharedState.create(spec.layout)
    shared.set_estop(EStop.CLEAR)
    clock, sink = VirtualClock(10.0), RecordingSink()
    tick = make_tick(spec, shared, sink, clock.now)
    source = stubs.robot(spec, clock)
    for step in range(5):  # until the joints are believed
        if step == 4:
            shared.rings["orders"].push(encode(Order(1, "follow", run=1)))
            shared.rings["orders"].push(encode(PostedChunk(1, 1, 4, np.tile(STANDS, (5, 1)))))
        for process in ("coordinator", "guard"):
            shared.beat(process, clock.now())
        shared.publish_observation(source.receive(0.0), dict.fromkeys(spec.cameras, 1))
        tick(step, clock.now())
        clock.advance(1 / 30)
    *_, record = (m for m in map(decode, shared.rings["ticks"].drain()) if isinstance(m, ExecutedTick))
    assert record.refused is refused
    assert [note for note in record.notes if "box" in note] == (
        ["left_arm would leave the workspace box"] if refused else []
    )
