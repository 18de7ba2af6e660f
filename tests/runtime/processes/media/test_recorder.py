from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from runtime.core.errors import RecordingError
from runtime.core.types import Observation
from runtime.ipc.messages import ExecutedTick, MergeResult, PolicyAnswer
from runtime.processes.media.recorder import DatasetGrid, Recorder
from runtime.recording.base import Journal, LostCamera, Outcome, RawChunk, Record, Row
from runtime.recording.settings import RecordingSettings
from tests.examples import some

CAMERA = "cam"
PICTURE = np.zeros((4, 6, 3), np.uint8)


class FakeJournal(Journal):
    """Keeps what it is given; fails from the moment it is told to."""

    def __init__(self) -> None:
        self.manifest: Mapping[str, object] = {}
        self.taken: list[Record] = []
        self.events: list[Mapping[str, object]] = []
        self.outcome: Outcome | None = None
        self.lost: list[LostCamera] = []
        self.failing: set[str] = set()

    def _check(self, name: str) -> None:
        if name in self.failing:
            raise RecordingError(f"disk full while {name}")

    def begin(self, manifest: Mapping[str, object]) -> None:
        self._check("begin")
        self.manifest = manifest

    def append(self, record: Record) -> None:
        self._check("append")
        self.taken.append(record)

    def append_event(self, event: Mapping[str, object]) -> None:
        self._check("mark")
        self.events.append(event)

    def pop_lost_cameras(self) -> list[LostCamera]:
        told, self.lost = self.lost, []
        return told

    def end(self, outcome: Outcome) -> None:
        self.outcome = outcome
        self._check("end")

    def of(self, kind: type[Any]) -> list[Any]:
        return [record for record in self.taken if isinstance(record, kind)]

    @property
    def rows(self) -> list[Row]:
        return self.of(Row)


class Desk:
    """A recorder with a fake journal, ticks and observations."""

    def __init__(self, rate: float = 30.0, fps: float = 30.0) -> None:
        self.journal = FakeJournal()
        robot = {"name": "toy", "joint_names": ["a", "b"], "eef_names": [], "dim": 2, "eef_dim": 8}
        grid = DatasetGrid(robot, (CAMERA,), rate, fps, lambda q: np.full(8, q[0] + 0.5, np.float32))
        self.recorder = Recorder(self.journal, Path("/episodes"), grid, lambda: 5.0)
        self.rate = rate

    def see(self, sequence: int, captured: float | None = None, **changes: Any) -> None:
        time = float(sequence) if captured is None else captured
        fields: dict[str, Any] = {
            "sequence": sequence,
            "arrived": float(sequence),
            "captured": {"joints": float(sequence), CAMERA: time},
            "qpos": np.full(2, sequence, np.float32),
            "pictures": {CAMERA: PICTURE + sequence},
        }
        self.recorder.add_observation(Observation(**(fields | changes)))

    def begin(self, run: int = 1) -> None:
        self.see(1)
        self.recorder.begin({"uuid": "one", "task": "t"}, run)

    def tick(self, step: int, sequence: int = 1, run: int = 1, **changes: Any) -> None:
        fields: dict[str, Any] = {
            "step": step,
            "run": run,
            "planned": 100.0 + step / self.rate,
            "sent": 100.0 + step / self.rate,
            "sequence": sequence,
            "source": "policy",
            "qpos": np.full(2, sequence, np.float32),
            "smoothed": None,
            "executed": np.full(2, step + 0.25, np.float32),
            "chunk_ids": [],
            "weights": [],
            "notes": [],
            "refused": False,
        }
        self.recorder.add_tick(ExecutedTick(**(fields | changes)))

    def answer(self, chunk: int, rows: int = 3, source: list[int] | None = None, run: int = 1) -> None:
        actions = np.full((rows, 2), chunk, np.float32)
        mapping = np.array(range(rows) if source is None else source)
        self.recorder.add_answer(PolicyAnswer(chunk, run, 10, actions, "joint", mapping, 12.0))

    def merge(self, chunk: int, targets: list[int], run: int = 1, dropped: str = "") -> None:
        self.recorder.add_merge(MergeResult(chunk, 12, 2, np.array(targets, np.int64), 0, dropped, run))


@pytest.fixture
def desk() -> Desk:
    desk = Desk()
    desk.begin()
    return desk


@settings(max_examples=some(60))
@given(
    rates=st.sampled_from([(30, 30), (100, 30), (200, 30), (30, 10), (30, 60), (50, 15)]),
    first=st.integers(0, 10_000),
    steps=st.sets(st.integers(1, 240)),
)
def test_row_k_is_the_last_tick_not_after_its_time_also_with_missed_ticks(
    rates: tuple[int, int], first: int, steps: set[int]
) -> None:
    rate, fps = rates
    desk = Desk(rate, fps)
    desk.begin()
    ticks = [0, *sorted(steps)]
    for step in ticks:
        desk.tick(first + step)
    expected, k = [], 0
    while k * rate // fps <= ticks[-1]:
        expected.append(first + max(t for t in ticks if t * fps <= k * rate))
        k += 1
    assert [row.step for row in desk.journal.rows] == expected
    assert [row.index for row in desk.journal.rows] == list(range(k))
    assert [tick.step for tick in desk.journal.of(ExecutedTick)] == [first + t for t in ticks]


def test_a_row_has_the_observation_and_the_action_of_its_tick(desk: Desk) -> None:
    desk.see(2, qvel=np.ones(2, np.float32))
    desk.tick(7, sequence=2)
    (row,) = desk.journal.rows
    assert (row.sequence, row.step, row.tick_time) == (2, 7, 100.0 + 7 / 30)
    assert (row.qpos == 2).all()
    assert (row.action == 7.25).all()
    assert row.qvel is not None
    assert row.captured == {"joints": 2.0, CAMERA: 2.0}
    assert (row.pictures[CAMERA] == 2).all()


def test_what_a_simulated_bench_says_is_in_the_rows_in_which_it_is_something_new(desk: Desk) -> None:
    lies = {"blocks": [[0.1, 0.2, 0.02, 0.0]], "plate": [0.3, 0.1], "reset": "a"}
    moved = {**lies, "blocks": [[0.1, 0.2, 0.05, 0.0]]}
    for sequence, truth in enumerate((lies, lies, moved, None, moved), start=2):
        desk.see(sequence, truth=truth)
        desk.tick(sequence, sequence=sequence)
    said = [row.bench and json.loads(row.bench)["blocks"][0][2] for row in desk.journal.rows]
    assert said == [0.02, None, 0.05, None, None]


def test_where_nothing_was_sent_the_measured_joints_are_the_action(desk: Desk) -> None:
    desk.tick(0, executed=None, source="none")
    (row,) = desk.journal.rows
    assert (row.action == row.qpos).all()
    assert row.control_source == "none"


def test_a_picture_that_a_row_has_already_is_repeated_and_counted(desk: Desk) -> None:
    desk.tick(0)
    desk.see(2, captured=1.0)  # newer joints, the same picture
    desk.tick(1, sequence=2)
    desk.see(3)
    desk.tick(2, sequence=3)
    assert [row.pictures[CAMERA] is None for row in desk.journal.rows] == [False, True, False]
    assert desk.recorder.repeated == 1


def test_an_observation_that_is_not_known_any_more_leaves_no_foreign_times_or_pictures(desk: Desk) -> None:
    desk.tick(0)
    desk.tick(1, sequence=99)
    row = desk.journal.rows[1]
    assert row.captured == {}
    assert row.pictures == {CAMERA: None}
    assert (row.qvel, row.effort) == (None, None)
    assert (row.qpos == 99).all()
    assert row.eef is not None
    assert (row.eef == 99.5).all()
    assert not row.eef_measured


def test_a_row_in_a_long_gap_keeps_the_observation_of_the_tick_before_it(desk: Desk) -> None:
    desk.tick(0)
    for sequence in range(2, 60):  # media went on receiving while control stood still
        desk.see(sequence)
    desk.tick(58, sequence=59)
    rows = desk.journal.rows
    assert len(rows) == 59
    assert all(row.captured == {"joints": 1.0, CAMERA: 1.0} for row in rows[:58])
    assert [row.pictures[CAMERA] is None for row in rows] == [False, *[True] * 57, False]
    assert rows[58].sequence == 59


def test_the_last_frame_of_the_source_ends_the_rows(desk: Desk) -> None:
    desk.tick(0)
    desk.see(2, last=True)
    desk.tick(1, sequence=2)
    desk.tick(2, sequence=2)
    assert [row.step for row in desk.journal.rows] == [0, 1]
    assert len(desk.journal.of(ExecutedTick)) == 2


def test_measured_poses_are_kept_and_others_come_from_kinematics(desk: Desk) -> None:
    told = np.arange(8, dtype=np.float32)
    desk.see(2, eef=told)
    desk.tick(0, sequence=2)
    desk.tick(1, sequence=1)
    first, second = desk.journal.rows
    assert first.eef is not None
    assert second.eef is not None
    assert (first.eef == told).all()
    assert first.eef_measured
    assert (second.eef == 1.5).all()
    assert not second.eef_measured


def test_reported_poses_count_only_for_the_very_action_that_was_sent(desk: Desk) -> None:
    told = np.arange(8, dtype=np.float32)
    desk.see(2, reported_action=np.full(2, 0.25, np.float32), reported_action_eef=told)
    desk.tick(0, sequence=2)  # sends 0.25
    desk.tick(1, sequence=2)  # sends 1.25
    first, second = desk.journal.rows
    assert first.eef_action is not None
    assert second.eef_action is not None
    assert first.eef_action_reported
    assert (first.eef_action == told).all()
    assert not second.eef_action_reported
    assert (second.eef_action == 1.75).all()


@pytest.mark.parametrize("order", ["answer first", "merge first"])
def test_an_answer_and_its_merge_make_one_raw_chunk_in_either_order(desk: Desk, order: str) -> None:
    steps = [lambda: desk.answer(4), lambda: desk.merge(4, [-1, -1, 12])]
    for step in steps if order == "answer first" else reversed(steps):
        assert desk.journal.of(RawChunk) == []
        step()
    (chunk,) = desk.journal.of(RawChunk)
    assert (chunk.chunk_id, chunk.observation_step, chunk.arrival_step, chunk.delay) == (4, 10, 12, 2)
    assert chunk.target_steps.tolist() == [-1, -1, 12]
    assert (chunk.actions == 4).all()


def test_a_resampled_row_counts_for_the_first_step_that_was_made_from_it(desk: Desk) -> None:
    desk.answer(4, rows=3, source=[0, 0, 1, 1, 2, 2])
    desk.merge(4, [-1, 11, 12, 13, 14, 15])
    (chunk,) = desk.journal.of(RawChunk)
    assert chunk.target_steps.tolist() == [-1, 12, 14]


@pytest.mark.parametrize("source", [[0, 0, 1, 1], [0, 2]])
def test_what_was_missed_of_a_row_is_the_worst_of_the_steps_made_from_it(
    desk: Desk, source: list[int]
) -> None:
    metres = np.array([[0.1, 0.0], [0.3, 0.2], [0.0, 0.4], [0.05, 0.0]])[: len(source)]
    flags = np.array([[1, 0], [2, 8], [0, 4], [1, 0]], np.uint8)[: len(source)]
    actions, mapping = np.zeros((3, 2), np.float32), np.array(source)
    answer = PolicyAnswer(4, 1, 10, actions, "eef", mapping, 12.0, metres, 2 * metres, flags, "fk")
    desk.recorder.add_answer(answer)
    desk.merge(4, list(range(len(source))))
    (chunk,) = desk.journal.of(RawChunk)
    expected = {
        4: ([[0.3, 0.2], [0.05, 0.4], [np.nan, np.nan]], [[3, 8], [1, 4], [0, 0]]),
        2: ([[0.1, 0.0], [np.nan, np.nan], [0.3, 0.2]], [[1, 0], [0, 0], [2, 8]]),
    }[len(source)]
    np.testing.assert_allclose(chunk.ik_position_error, expected[0], atol=1e-7)
    np.testing.assert_allclose(chunk.ik_rotation_error, 2 * np.array(expected[0]), atol=1e-7)
    np.testing.assert_array_equal(chunk.ik_flags, expected[1])
    assert chunk.eef == "fk"


def test_joint_rows_say_nothing_of_poses(desk: Desk) -> None:
    desk.answer(4)
    desk.merge(4, [10, 11, 12])
    (chunk,) = desk.journal.of(RawChunk)
    assert (chunk.ik_position_error, chunk.ik_rotation_error, chunk.ik_flags, chunk.eef) == (
        None,
        None,
        None,
        "",
    )


def test_answers_that_were_never_merged_are_written_at_the_end(desk: Desk) -> None:
    desk.answer(4)
    desk.recorder.end("finished", "over", {})()
    (chunk,) = desk.journal.of(RawChunk)
    assert (chunk.arrival_step, chunk.delay) == (-1, -1)
    assert chunk.target_steps.tolist() == [-1, -1, -1]
    assert math.isclose(chunk.inference_ms, 12.0)


def test_only_the_run_of_the_episode_is_recorded(desk: Desk) -> None:
    desk.tick(0, run=2)
    desk.answer(1, run=2)
    desk.merge(1, [1, 2, 3], run=2)
    assert desk.journal.taken == []
    desk.tick(1)
    assert [row.step for row in desk.journal.rows] == [1]


def test_a_recording_without_a_run_takes_every_tick() -> None:
    desk = Desk()
    desk.begin(run=0)
    desk.tick(0, run=0)
    desk.tick(1, run=3)
    assert [row.step for row in desk.journal.rows] == [0, 1]


def test_without_an_episode_nothing_is_written() -> None:
    desk = Desk()
    desk.see(1)
    desk.tick(0)
    desk.answer(1)
    desk.merge(1, [1, 2, 3])
    desk.recorder.add_event({"kind": "x"})
    assert desk.journal.taken == []
    assert desk.journal.events == []


def test_the_manifest_says_what_the_robot_sends() -> None:
    desk = Desk()
    desk.see(1, qvel=np.zeros(2, np.float32), eef=np.zeros(8, np.float32))
    desk.recorder.begin({"uuid": "one", "task": "t"}, 1)
    told = desk.journal.manifest
    assert told["streams"] == {"qvel": True, "effort": False, "eef": True, "eef_action": True}
    assert told["capture_streams"] == ["joints", "eef", CAMERA]
    assert told["cameras"] == {CAMERA: {"width": 6, "height": 4}}
    assert (told["fps"], told["control_rate"], told["started_monotonic"]) == (30.0, 30.0, 5.0)
    assert (told["uuid"], told["task"]) == ("one", "t")


def test_it_refuses_to_begin_before_every_camera_was_seen() -> None:
    desk = Desk()
    with pytest.raises(RecordingError, match="no observation"):
        desk.recorder.begin({}, 1)
    desk.see(1, pictures={})
    with pytest.raises(RecordingError, match="no picture has arrived from cam"):
        desk.recorder.begin({}, 1)
    assert desk.recorder.recording == ""


def test_it_refuses_a_second_episode_while_one_is_open(desk: Desk) -> None:
    with pytest.raises(RecordingError, match="episode one is still open"):
        desk.recorder.begin({}, 2)
    assert desk.recorder.recording == "one"


def test_a_journal_that_cannot_begin_leaves_nothing_open() -> None:
    desk = Desk()
    desk.journal.failing = {"begin"}
    desk.see(1)
    with pytest.raises(RecordingError, match="disk full"):
        desk.recorder.begin({"uuid": "one"}, 1)
    assert desk.recorder.recording == ""


def test_the_end_says_how_it_went_and_a_next_episode_counts_from_zero(desk: Desk) -> None:
    desk.tick(0)
    closed = desk.recorder.end("interrupted", "because", {"a": 1})()
    assert (closed.uuid, closed.status, closed.reason, closed.rows, closed.error) == (
        "one",
        "interrupted",
        "because",
        1,
        "",
    )
    assert closed.path == Path("/episodes/one")
    assert desk.journal.outcome is not None
    assert desk.journal.outcome.details == {"a": 1}
    assert desk.recorder.recording == ""
    desk.recorder.begin({"uuid": "two"}, 1)
    desk.tick(50)
    assert [row.index for row in desk.journal.rows] == [0, 0]


@pytest.mark.parametrize("failing", ["append", "end"])
def test_a_journal_that_fails_at_the_end_closes_the_episode_as_failed_with_the_error(
    desk: Desk, failing: str
) -> None:
    desk.tick(0)
    desk.answer(4)
    desk.journal.failing = {failing}
    closed = desk.recorder.end("finished", "over", {})()
    assert closed.status == "failed"
    assert closed.error == f"disk full while {failing}"
    assert closed.reason == closed.error
    assert desk.journal.outcome is not None  # it was told to end all the same
    assert desk.recorder.recording == ""


def test_an_ended_episode_takes_nothing_more_although_its_files_are_not_closed_yet(desk: Desk) -> None:
    desk.tick(0)
    close = desk.recorder.end("finished", "over", {})
    assert desk.recorder.recording == ""
    desk.tick(1)
    assert len(desk.journal.rows) == 1
    assert desk.journal.outcome is None
    assert close().rows == 1
    assert desk.journal.outcome is not None


def test_a_journal_that_fails_in_the_middle_raises(desk: Desk) -> None:
    desk.journal.failing = {"append", "mark"}
    with pytest.raises(RecordingError, match="append"):
        desk.tick(0)
    with pytest.raises(RecordingError, match="mark"):
        desk.recorder.add_event({"kind": "x"})


def test_a_chunk_is_kept_with_the_strategy_that_merged_it(desk: Desk) -> None:
    desk.answer(1)
    targets = np.array([12, 13, 14])
    desk.recorder.add_merge(MergeResult(1, 12, 2, targets, run=1, strategy="ensemble", overlap=2))
    desk.answer(2)
    desk.recorder.end("finished", "", {})
    merged, lost = desk.journal.of(RawChunk)
    assert (merged.strategy, merged.overlap) == ("ensemble", 2)
    assert (lost.strategy, lost.overlap, lost.arrival_step) == ("", 0, -1)


def test_a_row_of_a_simulated_robot_has_its_action_beside_what_was_measured(desk: Desk) -> None:
    desk.tick(7, source="sim")
    (row,) = desk.journal.rows
    assert row.control_source == "sim"
    assert (row.action == 7.25).all()
    assert (row.qpos == 1).all()


def test_a_camera_without_new_pictures_is_flagged_row_by_row_and_named_once() -> None:
    desk = Desk()
    desk.see(1, captured=100.0)
    desk.recorder.begin({"uuid": "one", "task": "t"}, 1)
    for step in range(60):  # pictures of its own until row 20, and from row 50 on
        fresh = step < 20 or step >= 50
        desk.see(step + 2, captured=100.0 + (step if fresh else 19) / 30.0)
        desk.tick(step, sequence=step + 2)
    stale = [CAMERA in row.stale for row in desk.journal.rows]
    assert stale == [34 < k < 50 for k in range(60)]  # half a second after its last picture, of row 19
    told = desk.recorder.pop_events()
    assert [(event.kind, event.data) for event in told] == [
        ("pictures_stopped", {"camera": CAMERA, "row": 35}),
        ("pictures_back", {"camera": CAMERA, "row": 50}),
    ]
    assert [event["kind"] for event in desk.journal.events] == ["pictures_stopped", "pictures_back"]
    assert desk.recorder.pop_events() == []


def test_a_camera_that_flutters_is_flagged_in_every_row_and_named_now_and_then() -> None:
    desk = Desk()
    desk.see(1, captured=100.0)
    desk.recorder.begin({"uuid": "one", "task": "t"}, 1)
    for step in range(100):  # 20 rows without a new picture of its own, 4 with, and so on
        seen = step if step % 24 >= 20 else step - step % 24
        desk.see(step + 2, captured=100.0 + seen / 30.0)
        desk.tick(step, sequence=step + 2)
    assert [CAMERA in row.stale for row in desk.journal.rows] == [16 <= step % 24 < 20 for step in range(100)]
    desk.recorder.end("finished", "", {})
    assert [(event["kind"], event["data"]) for event in desk.journal.events] == [
        ("pictures_stopped", {"camera": CAMERA, "row": 16}),
        ("pictures_back", {"camera": CAMERA, "row": 20}),
        ("pictures_back", {"camera": CAMERA, "row": 92, "more": 3, "since_row": 40}),
    ]


def test_a_camera_that_is_absent_from_what_arrives_is_flagged_too() -> None:
    desk = Desk()
    desk.begin()
    for step in range(30):
        desk.see(step + 2, pictures={})
        desk.tick(step, sequence=step + 2)
    assert [CAMERA in row.stale for row in desk.journal.rows] == [k > 15 for k in range(30)]


def test_what_the_journal_has_lost_is_told_once_and_stands_in_the_end() -> None:
    desk = Desk()
    desk.see(1, captured=100.0)
    desk.recorder.begin({"uuid": "one"}, 1)
    desk.tick(0)
    desk.journal.lost = [LostCamera(CAMERA, 7, "its encoder failed")]
    (event,) = desk.recorder.pop_events()
    assert (event.kind, event.data) == ("video_lost", {"camera": CAMERA, "row": 7})
    assert desk.recorder.pop_events() == []
    close = desk.recorder.end("finished", "stopped", {})
    desk.journal.lost = [LostCamera("wrist", 9, "did not end in time")]
    closed = close()
    assert closed.status == "finished"
    assert closed.reason.startswith("stopped; its encoder failed")
    assert "did not end in time" in closed.reason


def test_the_manifest_says_what_is_flagged_and_how_large_videos_are() -> None:
    desk = Desk()
    desk.see(1)
    desk.recorder.begin({"uuid": "one"}, 1)
    assert desk.journal.manifest["max_skew_s"] == 0.05
    assert desk.journal.manifest["cameras"] == {CAMERA: {"width": 6, "height": 4}}
    scaled = Desk()
    scaled.recorder._grid = replace(
        scaled.recorder._grid, recording=RecordingSettings(height=64, heights={"other": 32})
    )
    scaled.see(1, pictures={CAMERA: np.zeros((480, 640, 3), np.uint8)})
    collection = {"cameras": [CAMERA], "columns": None, "streams": [], "source": "relay", "max_skew_s": 0.2}
    scaled.recorder.begin({"uuid": "one", "collection": collection}, 1)
    assert scaled.journal.manifest["max_skew_s"] == 0.2
    assert scaled.journal.manifest["cameras"] == {
        CAMERA: {"width": 86, "height": 64, "captured_width": 640, "captured_height": 480}
    }


def test_answers_that_never_come_to_control_are_written_before_they_gather() -> None:
    desk = Desk()
    desk.begin()
    for chunk in range(300):
        desk.answer(chunk)
    chunks = desk.journal.of(RawChunk)
    assert [chunk.chunk_id for chunk in chunks] == list(range(44))
    assert {chunk.arrival_step for chunk in chunks} == {-1}
