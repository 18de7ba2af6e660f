from __future__ import annotations

import mmap
from collections import deque
from typing import Any

import numpy as np
import pytest

from runtime.core.clock import VirtualClock
from runtime.core.errors import TransportError
from runtime.core.types import Observation
from runtime.ipc.messages import Event
from runtime.ipc.shared_state import SharedState, SharedStateLayout
from runtime.processes.reception.receiver import ObservationReceiver
from tests.runtime.processes.media.test_media_process import FakeSource

RATE = 30.0


class Gate:
    """An intake with one camera; `order` says what was handed on, and whether the page had it by then."""

    def __init__(self) -> None:
        layout = SharedStateLayout(2, 8, ("cam",), 75)
        self.shared = SharedState(layout, mmap.mmap(-1, SharedState.size(layout)))
        self.clock, self.source = VirtualClock(100.0), FakeSource()
        self.said: list[Event] = []
        self.order: list[tuple[int, dict[str, int], bool]] = []
        self.intake = self.begun()

    def begun(self) -> ObservationReceiver:
        return ObservationReceiver(self.shared, self.source, self.clock, self.said.append, self.hand_on)

    def hand_on(self, seen: Observation, numbers: Any) -> None:
        self.order.append((seen.sequence, dict(numbers), self.published() == seen.sequence))

    def published(self) -> int:
        seen = self.shared.read_observation(())
        return -1 if seen is None else int(seen.sequence)

    def observation(self, sequence: int, **changes: Any) -> Observation:
        now = self.clock.now()
        fields: dict[str, Any] = {
            "sequence": sequence,
            "arrived": now,
            "captured": {"joints": now, "cam": now},
            "qpos": np.zeros(2, np.float32),
            "pictures": {"cam": np.zeros((5, 5, 3), np.uint8)},
        }
        return Observation(**(fields | changes))

    def receive(self, count: int, **changes: Any) -> None:
        for sequence in range(1, count + 1):
            self.source.waiting.append(self.observation(sequence, **changes))
            self.intake.poll(0.0)
            self.clock.advance(1 / RATE)


@pytest.fixture
def gate() -> Gate:
    return Gate()


def test_an_observation_is_handed_on_with_its_pictures_in_place_before_the_page_has_it(gate: Gate) -> None:
    gate.receive(1)
    assert gate.order == [(1, {"cam": 1}, False)]
    assert gate.shared.pictures["cam"].read(1) is not None
    assert gate.published() == 1


def test_a_successor_goes_on_counting_also_where_the_page_was_not_told_of_the_last_picture(
    gate: Gate,
) -> None:
    gate.receive(2)
    gate.shared.pictures["cam"].write(3, np.ones((5, 5, 3), np.uint8))  # and then it died
    gate.intake = gate.begun()
    gate.receive(1)
    assert gate.order[-1] == (3, {"cam": 4}, False)
    assert gate.published() == 3


def test_how_old_joints_are_when_they_are_in_the_page_is_told(gate: Gate) -> None:
    assert gate.intake.age_ms() == {}
    for late in (0.01, 0.02, 0.03):
        now = gate.clock.now()
        gate.receive(1, captured={"joints": now - late, "cam": now})
    assert gate.intake.age_ms() == pytest.approx({"p50": 20.0, "p99": 29.8, "max": 30.0})


def test_rates_are_those_of_arrivals_and_none_after_a_silence(gate: Gate) -> None:
    assert gate.intake.rates() == {}
    gate.receive(1)
    assert gate.intake.rates() == {"cam": 0.0, "joints": 0.0}
    gate.receive(50)
    assert gate.intake.rates() == pytest.approx({"cam": RATE, "joints": RATE})
    gate.clock.advance(2.1)
    assert gate.intake.rates() == {"cam": 0.0, "joints": 0.0}


def test_a_fault_is_said_when_its_count_has_grown(gate: Gate) -> None:
    gate.source.counts["frozen_cam"] = 2
    assert gate.intake.faults() == {"frozen_cam": 2}
    gate.intake.faults()
    gate.clock.advance(5.0)
    gate.source.counts["frozen_cam"] = 3
    gate.intake.faults()
    assert [(event.kind, event.text) for event in gate.said] == [
        ("source_frozen_cam", "source: frozen cam (2 so far)"),
        ("source_frozen_cam", "source: frozen cam (3 so far)"),
    ]


def test_what_a_node_never_sends_in_a_usable_form_is_said_once_in_each_run(gate: Gate) -> None:
    def thirty_seconds() -> None:
        for _ in range(900):
            gate.source.counts["eef_unusable"] = gate.source.counts.get("eef_unusable", 0) + 1
            assert gate.intake.faults() == gate.source.counts
            gate.clock.advance(1 / RATE)

    thirty_seconds()
    for _ in range(2):
        gate.intake.begin_run()
        thirty_seconds()
    assert [event.kind for event in gate.said] == ["source_eef_unusable"] * 3
    assert [event.data["count"] for event in gate.said] == [1, 901, 1801]


def test_a_fault_that_goes_on_is_said_every_five_seconds_and_nothing_of_it_is_lost(gate: Gate) -> None:
    for count in range(1, 101):
        gate.source.counts["frames_lost_cam"] = count
        assert gate.intake.faults() == {"frames_lost_cam": count}
        gate.clock.advance(0.125)
    gate.clock.advance(5.0)
    gate.intake.faults()
    gate.intake.faults()
    assert [event.data["count"] for event in gate.said] == [1, 41, 81, 100]


def test_a_source_that_counts_anew_is_heard_again(gate: Gate) -> None:
    for count in (100, 0, 3):
        gate.source.counts["stalled_cam"] = count
        gate.intake.faults()
        gate.clock.advance(5.0)
    assert [event.data["count"] for event in gate.said] == [100, 3]


def test_a_fault_is_said_with_its_sentence_where_the_source_has_one(
    gate: Gate, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate.source.counts.update({"missing_camera": 1, "node_refused.stale": 2})
    why = {"missing_camera": "images lack cam", "node_refused.stale": "too late"}
    monkeypatch.setattr(gate.source, "describe_fault", why.get)
    gate.intake.faults()
    assert [event.text for event in gate.said] == [
        "source: missing camera (1 so far): images lack cam",
        "source: node refused: stale (2 so far): too late",
    ]


def test_a_picture_that_has_no_room_is_counted_and_not_written(gate: Gate) -> None:
    gate.receive(2, pictures={"cam": np.zeros((6, 6, 3), np.uint8)})
    assert gate.intake.faults() == {"picture_too_large_cam": 2}
    assert gate.shared.observation.read()["picture_number"].tolist() == [0]


def test_a_source_that_fails_is_said_once_and_again_after_it_came_back(gate: Gate) -> None:
    failure = TransportError("the node is gone")
    gate.source.waiting = deque([failure, failure])
    gate.intake.poll(0.0)
    gate.intake.poll(0.0)
    gate.receive(1)
    gate.source.waiting.append(failure)
    gate.intake.poll(0.0)
    assert [event.text for event in gate.said] == ["the node is gone", "the node is gone"]


def test_truth_and_drives_are_those_of_the_newest_observation(gate: Gate) -> None:
    gate.receive(1, truth={"success": True}, drives={"enabled": False, "faults": []})
    assert gate.intake.truth == {"success": True}
    assert gate.intake.drives == {"enabled": False, "faults": []}
    assert [event.text for event in gate.said] == ["drives disabled"]
    gate.receive(1)
    assert (gate.intake.truth, gate.intake.drives) == ({}, {})


def test_a_run_begins_with_the_sources_first_frame(gate: Gate) -> None:
    gate.source.first = gate.observation(7)
    gate.intake.begin_run()
    assert (gate.source.begun, gate.published()) == (1, 7)
