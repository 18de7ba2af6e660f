from __future__ import annotations

import json
import mmap
import threading
from collections import deque
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runtime.core.clock import VirtualClock
from runtime.core.errors import RecordingError, TransportError
from runtime.core.types import Observation
from runtime.ipc.messages import (
    BeginEpisode,
    EndEpisode,
    EpisodeClosed,
    EpisodeOpened,
    Event,
    ExecutedTick,
    MediaReport,
    Message,
    ReceptionReport,
    RunBegun,
    decode,
    encode,
)
from runtime.ipc.shared_state import PICTURE_SLOTS, SharedState, SharedStateLayout
from runtime.processes.media.crash_repair import find_open_episodes, repair_open_episodes
from runtime.processes.media.process import Media
from runtime.processes.media.recorder import DatasetGrid, Recorder
from runtime.processes.media.unclosed_episodes import at_once, in_background
from runtime.processes.reception.process import Reception
from runtime.recording.base import Outcome
from runtime.recording.files import UnclosedError
from runtime.recording.repair import RepairReport
from runtime.transports.base import Source
from tests.processes import PATIENCE_S
from tests.runtime.processes.media.test_recorder import FakeJournal

RATE = 30.0
CAMERAS = ("left", "right")


class FakeSource(Source):
    """Delivers what the test lays out; a new run begins with a frame of its own."""

    def __init__(self) -> None:
        self.waiting: deque[Observation | Exception] = deque()
        self.first: Observation | None = None
        self.counts: dict[str, int] = {}
        self.begun = self.ended = 0

    def connect(self) -> None:
        pass

    def receive(self, timeout: float) -> Observation | None:
        if not self.waiting:
            return None
        found = self.waiting.popleft()
        if isinstance(found, Exception):
            raise found
        return found

    def close(self) -> None:
        pass

    def begin_run(self) -> None:
        self.begun += 1
        if self.first is not None:
            self.waiting.append(self.first)

    def end_run(self) -> None:
        self.ended += 1

    def faults(self) -> dict[str, int]:
        return dict(self.counts)


class Desk:
    def __init__(self, closer: Any = at_once) -> None:
        layout = SharedStateLayout(2, 8, CAMERAS, 300)
        self.shared = SharedState(layout, mmap.mmap(-1, SharedState.size(layout)))
        self.clock, self.source, self.journal = VirtualClock(100.0), FakeSource(), FakeJournal()
        robot = {"name": "toy", "joint_names": ["a", "b"], "eef_names": [], "dim": 2, "eef_dim": 0}
        grid = DatasetGrid(robot, CAMERAS, RATE, RATE, lambda q: q)
        recorder = Recorder(self.journal, Path("/episodes"), grid, self.clock.now)
        self.previewed: list[int] = []
        self.on_disk: list[Path] = []
        preview = lambda o: self.previewed.append(o.sequence)  # noqa: E731
        self.media = Media(self.shared, recorder, self.clock, preview, closer, self.on_disk.append)
        self.reception = Reception(self.shared, self.source, self.clock)

    def observation(self, sequence: int, **changes: Any) -> Observation:
        now = self.clock.now()
        picture = np.full((5, 5, 3), sequence, np.uint8)
        fields: dict[str, Any] = {
            "sequence": sequence,
            "arrived": now,
            "captured": {"joints": now, "left": now, "right": now},
            "qpos": np.full(2, sequence, np.float32),
            "pictures": dict.fromkeys(CAMERAS, picture),
        }
        return Observation(**(fields | changes))

    def pump(self, timeout: float = 0.0) -> None:
        """What both processes do, and what comes of it at once."""
        self.reception.poll(timeout)
        self.media.poll()
        if self.reception.poll_commands():
            self.media.poll()

    def receive(self, *sequences: int) -> None:
        for sequence in sequences:
            self.source.waiting.append(self.observation(sequence))
            self.pump()
            self.clock.advance(1 / RATE)

    def post(self, message: Message, ring: str = "minutes") -> None:
        self.shared.rings[ring].push(encode(message))

    def begin(self, run: int = 1, **manifest: Any) -> None:
        self.post(BeginEpisode(run, {"uuid": "one"} | manifest))
        self.pump()

    def tick(self, step: int, sequence: int, run: int = 1) -> None:
        now, q = self.clock.now(), np.zeros(2, np.float32)
        self.post(
            ExecutedTick(step, run, now, now, sequence, "policy", q, None, q, [], [], [], False), "ticks"
        )

    def told(self, kind: type[Any]) -> list[Any]:
        return [message for message in self.heard() if isinstance(message, kind)]

    def heard(self) -> list[Message]:
        """All that the coordinator has not heard yet, that of reception first."""
        rings = (self.shared.rings[name] for name in ("reception_events", "media_events"))
        return [decode(payload) for ring in rings for payload in ring.drain()]


@pytest.fixture
def desk() -> Desk:
    return Desk()


def test_an_observation_reaches_the_page_with_its_pictures_and_the_preview(desk: Desk) -> None:
    desk.receive(1)
    seen = desk.shared.read_observation(CAMERAS)
    assert seen is not None
    assert (seen.sequence, seen.captured["left"]) == (1, 100.0)
    assert all((seen.pictures[camera] == 1).all() for camera in CAMERAS)
    assert desk.previewed == [1]


def test_a_picture_that_is_not_new_is_not_written_again(desk: Desk) -> None:
    desk.receive(1)
    desk.source.waiting.append(desk.observation(2, captured={"joints": 100.2, "left": 100.0, "right": 100.2}))
    desk.pump()
    record = desk.shared.observation.read()
    assert record["picture_number"].tolist() == [1, 2]
    assert record["picture_captured"].tolist() == [100.0, 100.2]


def test_a_restarted_reception_goes_on_counting_pictures(desk: Desk) -> None:
    desk.receive(1, 2)
    desk.reception = Reception(desk.shared, desk.source, desk.clock)
    desk.source.waiting.append(desk.observation(3))
    desk.pump()
    assert desk.shared.observation.read()["picture_number"].tolist() == [3, 3]
    seen = desk.shared.read_observation(CAMERAS)
    assert seen is not None
    assert (seen.pictures["left"] == 3).all()


def test_rates_are_measured_per_stream(desk: Desk) -> None:
    desk.receive(*range(1, 31))
    report = desk.told(ReceptionReport)[-1]
    assert report.rates["joints"] == pytest.approx(RATE)
    assert report.rates["left"] == pytest.approx(RATE)
    desk.clock.advance(3.0)
    desk.pump()
    assert desk.told(ReceptionReport)[-1].rates["joints"] == 0.0


def test_malformed_messages_are_counted_told_once_per_change_and_written_into_the_episode(desk: Desk) -> None:
    desk.receive(1)
    desk.begin()
    desk.told(Event)
    desk.source.counts = {"malformed": 3}
    desk.clock.advance(1.0)
    desk.pump()
    desk.clock.advance(1.0)
    desk.pump()
    messages = desk.heard()
    events = [m for m in messages if isinstance(m, Event)]
    assert [(e.kind, e.text) for e in events] == [("source_malformed", "source: malformed (3 so far)")]
    assert [m.faults for m in messages if isinstance(m, ReceptionReport)] == [{"malformed": 3}] * 2
    assert [event["kind"] for event in desk.journal.events] == ["source_malformed"]


def test_a_source_that_fails_is_told_once_and_received_from_again(desk: Desk) -> None:
    desk.source.waiting.extend([TransportError("frame 7 cannot be decoded")] * 3)
    for _ in range(3):
        desk.pump(0.01)
    assert [e.text for e in desk.told(Event)] == ["frame 7 cannot be decoded"]
    assert desk.clock.now() == pytest.approx(100.03)  # it waits and does not spin
    desk.receive(1)
    assert desk.shared.observation.read()["sequence"] == 1
    desk.source.waiting.append(TransportError("frame 7 cannot be decoded"))
    desk.pump()
    assert len(desk.told(Event)) == 1


def test_a_picture_too_large_for_the_page_is_named_and_the_rest_goes_on(desk: Desk) -> None:
    large = np.zeros((11, 11, 3), np.uint8)
    pictures = {"left": large, "right": np.zeros((5, 5, 3), np.uint8)}
    desk.source.waiting.append(desk.observation(1, pictures=pictures))
    desk.pump()
    assert [e.kind for e in desk.told(Event)] == ["source_picture_too_large_left"]
    assert desk.shared.observation.read()["picture_number"].tolist() == [0, 1]
    assert desk.shared.observation.read()["sequence"] == 1


def test_a_run_begins_with_the_first_frame_of_the_source(desk: Desk) -> None:
    desk.receive(1)
    desk.source.first = desk.observation(2)
    desk.begin()
    assert desk.source.begun == 1
    assert desk.shared.observation.read()["sequence"] == 2  # before the coordinator hears that it may begin
    (opened,) = desk.told(EpisodeOpened)
    assert (opened.run, opened.uuid, opened.path, opened.error) == (1, "one", "/episodes/one", "")
    assert desk.media.recording


def test_a_run_that_is_not_recorded_begins_all_the_same(desk: Desk) -> None:
    desk.receive(1)
    desk.post(BeginEpisode(4, None))
    desk.pump()
    assert desk.source.begun == 1
    (opened,) = desk.told(EpisodeOpened)
    assert (opened.run, opened.uuid, opened.error) == (4, "", "")
    assert not desk.media.recording


def test_a_recording_without_a_run_leaves_the_source_alone(desk: Desk) -> None:
    desk.receive(1)
    desk.begin(run=0)
    assert desk.source.begun == 0
    assert desk.media.recording


def test_an_episode_that_cannot_begin_is_told_with_the_reason(desk: Desk) -> None:
    desk.begin()  # nothing has been seen yet
    (opened,) = desk.told(EpisodeOpened)
    assert "no observation has arrived" in opened.error
    assert desk.source.begun == 0
    desk.receive(1)
    desk.journal.failing = {"begin"}
    desk.begin(run=2)
    assert desk.told(EpisodeOpened)[-1].error == "disk full while begin"
    assert not desk.media.recording


def test_ticks_become_rows_and_the_end_is_told(desk: Desk) -> None:
    desk.receive(1)
    desk.begin()
    desk.tick(0, 1)
    desk.tick(1, 1)
    desk.pump()
    desk.post(EndEpisode("finished", "over", {"a": 1}))
    desk.pump()
    (closed,) = desk.told(EpisodeClosed)
    assert (closed.uuid, closed.status, closed.reason, closed.rows, closed.error) == (
        "one",
        "finished",
        "over",
        2,
        "",
    )
    assert len(desk.journal.rows) == 2
    assert not desk.media.recording


def test_a_tick_done_before_the_end_was_decided_is_still_recorded(desk: Desk) -> None:
    desk.receive(1)
    desk.begin()
    desk.tick(0, 1)
    desk.post(EndEpisode("finished", "over"))  # both wait in their rings when media comes to them
    desk.pump()
    assert desk.told(EpisodeClosed)[0].rows == 1


def test_a_recording_that_fails_is_an_event_and_closes_the_episode(desk: Desk) -> None:
    desk.receive(1)
    desk.begin()
    desk.told(Event)
    desk.journal.failing = {"append"}
    desk.tick(0, 1)
    desk.tick(1, 1)
    desk.pump()
    messages = desk.heard()
    assert [m.text for m in messages if isinstance(m, Event)] == ["disk full while append"]
    (closed,) = [m for m in messages if isinstance(m, EpisodeClosed)]
    assert (closed.status, closed.reason) == ("failed", "disk full while append")
    assert not desk.media.recording
    desk.receive(2)  # and life goes on
    assert desk.shared.observation.read()["sequence"] == 2


def test_an_event_that_cannot_be_written_fails_the_recording_too(desk: Desk) -> None:
    desk.receive(1)
    desk.begin()
    desk.journal.failing = {"mark"}
    desk.post(Event("x", "y", 1.0))
    desk.pump()
    assert [m.kind for m in desk.told(Event)] == ["recording_failed"]
    assert not desk.media.recording


def test_a_recording_whose_end_was_never_told_is_closed_where_another_one_begins(desk: Desk) -> None:
    desk.receive(1)
    desk.begin(run=0)
    desk.tick(0, 1)
    desk.pump()
    desk.post(BeginEpisode(2, {"uuid": "two"}))
    desk.pump()
    messages = [decode(payload) for payload in desk.shared.rings["media_events"].drain()]
    (closed,) = [m for m in messages if isinstance(m, EpisodeClosed)]
    assert (closed.uuid, closed.status, closed.rows) == ("one", "interrupted", 1)
    assert closed.reason == "no end received; another recording begins"
    opened = [m for m in messages if isinstance(m, EpisodeOpened)][-1]
    assert (opened.uuid, opened.error) == ("two", "")
    assert desk.media.recording


def test_what_was_addressed_to_a_predecessor_is_not_obeyed(desk: Desk) -> None:
    desk.receive(1)
    desk.post(BeginEpisode(1, {"uuid": "old"}))
    desk.tick(0, 1)
    Media(desk.shared, desk.media._recorder, desk.clock).poll()
    assert not desk.media.recording
    assert desk.source.begun == 0


def another_coordinator(desk: Desk) -> None:
    desk.shared.set_generation("coordinator", desk.shared.generation("coordinator") + 1)


def test_what_a_coordinator_asked_for_ends_with_it_however_fast_the_next_one_is_there(desk: Desk) -> None:
    desk.receive(1)
    desk.begin()
    desk.tick(0, 1)
    desk.pump()
    another_coordinator(desk)
    desk.pump()
    (closed,) = desk.told(EpisodeClosed)
    assert (closed.uuid, closed.status, closed.rows) == ("one", "interrupted", 1)
    assert closed.reason == "the coordinator has given no sign of life since it was restarted"
    desk.post(BeginEpisode(2, {"uuid": "late"}))  # of the one that died
    desk.pump()
    assert not desk.media.recording
    desk.post(BeginEpisode(3, {"uuid": "two"}, desk.shared.generation("coordinator")))
    desk.pump()
    assert [opened.uuid for opened in desk.told(EpisodeOpened)] == ["two"]


def test_what_a_coordinator_said_before_it_died_is_heard(desk: Desk) -> None:
    desk.receive(1)
    desk.begin()
    desk.tick(0, 1)
    desk.pump()
    desk.tick(1, 1)
    desk.post(EndEpisode("finished", "stopped by the operator", {}))
    another_coordinator(desk)
    desk.post(BeginEpisode(1, {"uuid": "two"}, desk.shared.generation("coordinator")))
    desk.pump()
    told = desk.heard()
    (closed,) = [message for message in told if isinstance(message, EpisodeClosed)]
    assert (closed.uuid, closed.status, closed.rows) == ("one", "finished", 2)
    assert closed.reason == "stopped by the operator"
    assert [opened.uuid for opened in told if isinstance(opened, EpisodeOpened)] == ["one", "two"]


def test_what_control_did_for_a_coordinator_that_died_is_kept_and_the_source_is_told_to_end(
    desk: Desk,
) -> None:
    desk.receive(1)
    desk.begin()
    desk.pump()
    desk.tick(0, 1)
    desk.tick(1, 1)
    ended = desk.source.ended
    another_coordinator(desk)
    desk.pump()
    desk.pump()
    (closed,) = desk.told(EpisodeClosed)
    assert (closed.status, closed.rows) == ("interrupted", 2)
    assert desk.source.ended == ended + 1


def test_a_run_that_the_source_began_for_a_coordinator_that_died_is_not_that_of_the_next_one(
    desk: Desk,
) -> None:
    desk.receive(1)
    another_coordinator(desk)
    desk.post(BeginEpisode(1, {"uuid": "two"}, desk.shared.generation("coordinator")))
    desk.media.poll()
    desk.post(RunBegun(1, desk.shared.generation("coordinator") - 1), "observations")
    desk.media.poll()
    assert desk.told(EpisodeOpened) == []
    desk.pump()
    assert [opened.uuid for opened in desk.told(EpisodeOpened)] == ["two"]


def test_a_coordinator_that_asks_while_media_is_busy_with_what_was_before_is_heard(desk: Desk) -> None:
    def meanwhile(seen: Observation) -> None:
        another_coordinator(desk)
        desk.post(BeginEpisode(2, {"uuid": "two"}, desk.shared.generation("coordinator")))

    desk.receive(1)
    desk.begin()
    desk.media._preview = meanwhile
    desk.receive(2)
    assert [closed.uuid for closed in desk.told(EpisodeClosed)] == ["one"]
    assert desk.media.recording
    assert desk.journal.manifest["uuid"] == "two"


def test_the_report_counts_rows_and_repeated_pictures(desk: Desk) -> None:
    desk.receive(1)
    desk.begin()
    desk.tick(0, 1)
    desk.tick(1, 1)
    desk.clock.advance(1.0)
    desk.pump()
    report = desk.told(MediaReport)[-1]
    assert (report.rows, report.recording, report.repeated) == (2, "one", 2)


# --- what two processes see ---------------------------------------------------------------------------------


def test_a_tick_that_comes_before_the_observation_it_saw_was_read_is_a_row_of_that_one(desk: Desk) -> None:
    desk.receive(1)
    desk.begin()
    drain = desk.shared.rings["observations"].drain

    def late() -> Any:
        desk.shared.rings["observations"].drain = drain  # type: ignore[method-assign]
        yield from drain()
        desk.source.waiting.append(desk.observation(2))
        desk.reception.poll(0.0)
        desk.tick(0, 2)

    desk.shared.rings["observations"].drain = late  # type: ignore[method-assign]
    desk.media.poll()
    (row,) = desk.journal.rows
    assert row.lost == frozenset()
    assert all((row.pictures[camera] == 2).all() for camera in CAMERAS)  # type: ignore[union-attr]


def test_pictures_that_were_overwritten_before_they_were_recorded_are_lost_and_said_to_be(desk: Desk) -> None:
    desk.receive(1)
    desk.begin()
    desk.tick(0, 1)
    desk.media.poll()
    for sequence in range(2, PICTURE_SLOTS + 4):  # media does nothing meanwhile
        desk.source.waiting.append(desk.observation(sequence))
        desk.reception.poll(0.0)
        desk.clock.advance(1 / RATE)
        desk.tick(sequence - 1, sequence)
    desk.media.poll()
    lost = [row.lost == set(CAMERAS) for row in desk.journal.rows]
    assert lost == [False, True, True, *[False] * PICTURE_SLOTS]
    shown = [row.pictures["left"] for row in desk.journal.rows]
    assert [None if seen is None else int(seen[0, 0, 0]) for seen in shown] == [
        1,
        None,
        None,
        *range(4, PICTURE_SLOTS + 4),
    ]
    assert [row.sequence for row in desk.journal.rows] == [*range(1, PICTURE_SLOTS + 4)]


def test_what_media_had_no_room_for_is_lost_in_its_rows_and_said(
    desk: Desk, caplog: pytest.LogCaptureFixture
) -> None:
    desk.receive(1)
    desk.begin()
    desk.tick(0, 1)
    desk.media.poll()
    push = desk.shared.rings["observations"].push
    desk.shared.rings["observations"].push = lambda payload: False  # type: ignore[method-assign]
    desk.receive(2, 3)
    desk.shared.rings["observations"].push = push  # type: ignore[method-assign]
    desk.tick(1, 3)
    desk.receive(4)
    desk.tick(2, 4)
    desk.media.poll()
    assert [row.lost for row in desk.journal.rows] == [frozenset(), set(CAMERAS), frozenset()]
    assert caplog.text.count("media does not read") == 1
    assert desk.shared.observation.read()["sequence"] == 4  # and control saw all of them


def test_a_recording_goes_on_over_another_reception(desk: Desk) -> None:
    desk.receive(1, 2)
    desk.begin(run=0)
    desk.tick(0, 2, run=0)
    desk.media.poll()
    desk.reception, desk.source.waiting = Reception(desk.shared, desk.source, desk.clock), deque()
    desk.receive(1)
    assert desk.shared.observation.read()["sequence"] == 3
    desk.tick(1, 3, run=0)
    desk.media.poll()
    assert [row.sequence for row in desk.journal.rows] == [2, 3]
    assert [row.lost for row in desk.journal.rows] == [frozenset(), frozenset()]


def test_a_run_that_ends_before_its_source_began_is_not_opened_afterwards(desk: Desk) -> None:
    desk.receive(1)
    desk.post(BeginEpisode(1, {"uuid": "one"}))
    desk.post(EndEpisode("interrupted", "reception died"))
    desk.pump()
    assert desk.told(EpisodeOpened) == []
    assert desk.source.begun == desk.source.ended == 1
    assert not desk.media.recording


def test_a_restarted_media_lets_the_run_of_its_predecessor_end(desk: Desk) -> None:
    desk.receive(1)
    desk.begin()
    ended = desk.source.ended
    desk.media = Media(desk.shared, desk.media._recorder, desk.clock)
    desk.reception.poll(0.0)
    assert desk.source.ended == ended + 1


# --- an end that takes long --------------------------------------------------------------------------------


class SlowDisk:
    """Closes an episode when the test lets it."""

    def __init__(self) -> None:
        self.calls: list[tuple[Future[Any], Any]] = []

    def __call__(self, close: Any) -> Future[Any]:
        done: Future[Any] = Future()
        self.calls.append((done, close))
        return done

    def finish(self) -> None:
        done, close = self.calls.pop(0)
        done.set_result(close())


@pytest.fixture
def disk() -> SlowDisk:
    return SlowDisk()


@pytest.fixture
def slow(disk: SlowDisk) -> Desk:
    """A desk whose first episode is being closed."""
    desk = Desk(disk)
    desk.receive(1)
    desk.begin()
    desk.tick(0, 1)
    desk.post(EndEpisode("finished", "over"))
    desk.pump()
    desk.told(Event)
    return desk


def test_while_an_episode_is_being_closed_media_receives_and_still_counts_it_as_recording(
    slow: Desk, disk: SlowDisk
) -> None:
    slow.receive(*range(2, 12))
    messages = slow.heard()
    assert slow.shared.observation.read()["sequence"] == 11
    assert [m.recording for m in messages if isinstance(m, MediaReport)][-1] == "one"
    assert [m for m in messages if isinstance(m, EpisodeClosed)] == []
    disk.finish()
    slow.pump()
    (closed,) = slow.told(EpisodeClosed)
    assert (closed.uuid, closed.status, closed.rows) == ("one", "finished", 1)
    slow.clock.advance(1.0)
    slow.pump()
    assert slow.told(MediaReport)[-1].recording == ""


def test_a_run_that_is_asked_for_meanwhile_begins_when_the_disk_is_done(slow: Desk, disk: SlowDisk) -> None:
    slow.post(BeginEpisode(2, {"uuid": "two"}))
    slow.post(Event("x", "of the second", 1.0))
    slow.pump()
    assert slow.told(EpisodeOpened) == []
    disk.finish()
    slow.pump()
    messages = slow.heard()
    kept = [m for m in messages if isinstance(m, EpisodeClosed | EpisodeOpened)]
    assert [m.uuid for m in kept] == ["one", "two"]
    assert slow.journal.events[-1]["text"] == "of the second"


def test_a_run_that_waits_for_the_disk_never_begins_where_its_coordinator_dies(
    slow: Desk, disk: SlowDisk
) -> None:
    slow.post(BeginEpisode(2, {"uuid": "two"}))
    slow.pump()
    another_coordinator(slow)
    slow.pump()
    disk.finish()
    slow.pump()
    slow.clock.advance(1.01)
    slow.pump()
    assert slow.told(EpisodeOpened) == []
    assert not slow.media.recording


def test_a_run_is_refused_where_the_disk_takes_its_time(slow: Desk, disk: SlowDisk) -> None:
    slow.post(BeginEpisode(2, {"uuid": "two"}))
    slow.pump()
    slow.clock.advance(1.01)
    slow.pump()
    (opened,) = slow.told(EpisodeOpened)
    assert opened.run == 2
    assert "the last episode is still being written" in opened.error
    assert slow.source.begun == 1  # of the first run
    disk.finish()
    slow.pump()
    slow.begin(run=3, uuid="three")
    assert slow.told(EpisodeOpened)[-1].uuid == "three"


class FullDisk:
    """Takes the end of an episode when the test gives it room."""

    def __init__(self, desk: Desk) -> None:
        self.room, self.tries, self._end = False, 0, desk.journal.end
        desk.journal.end = self.end  # type: ignore[method-assign]

    def end(self, outcome: Outcome) -> None:
        self.tries += 1
        if not self.room:
            raise UnclosedError("disk full while writing it", lambda: self.end(outcome))
        self._end(outcome)


def unclosed(desk: Desk) -> FullDisk:
    """An episode has ended and found no room."""
    full = FullDisk(desk)
    desk.receive(1)
    desk.begin()
    desk.tick(0, 1)
    desk.post(EndEpisode("finished", "over"))
    desk.pump()
    return full


def test_the_end_of_an_episode_that_found_no_room_is_tried_again_and_told_twice(desk: Desk) -> None:
    full = unclosed(desk)
    (waits,) = desk.told(EpisodeClosed)
    assert (waits.waits, waits.status, waits.error) == (True, "failed", "disk full while writing it")
    assert desk.on_disk == []
    times = []
    for _ in range(700):
        desk.clock.advance(0.1)
        before = full.tries
        desk.media.poll()
        times += [round(desk.clock.now(), 1)] if full.tries > before else []
    assert desk.told(MediaReport)[-1].unclosed == {"one": "disk full while writing it"}
    gaps = np.diff(times).round(1).tolist()
    assert gaps == pytest.approx([2.0, 4.0, 8.0, 16.0, 30.0], abs=0.11)
    full.room = True
    desk.clock.advance(30.0)
    desk.media.poll()
    (closed,) = desk.told(EpisodeClosed)
    assert (closed.uuid, closed.waits, closed.status, closed.reason, closed.rows) == (
        "one",
        False,
        "finished",
        "over",
        1,
    )
    assert desk.on_disk == [Path("/episodes/one")]
    desk.clock.advance(30.0)
    desk.media.poll()
    assert desk.told(MediaReport)[-1].unclosed == {}


def test_an_episode_that_waits_for_room_is_in_no_other_ones_way(desk: Desk) -> None:
    full = unclosed(desk)
    desk.begin(run=2, uuid="two")
    assert desk.told(EpisodeOpened)[-1].uuid == "two"
    full.room = True
    desk.clock.advance(1.5)
    desk.media.poll()
    assert desk.media.recording
    assert desk.told(EpisodeClosed)[-1].uuid == "one"


@pytest.mark.parametrize("room", [True, False])
def test_at_the_end_of_the_process_what_waits_is_tried_once_more(
    desk: Desk, room: bool, caplog: pytest.LogCaptureFixture
) -> None:
    full = unclosed(desk)
    full.room = room
    tries = full.tries
    desk.media.finish(1.0)
    assert full.tries == tries + 1
    assert (desk.told(EpisodeClosed)[-1].waits, "the next start completes it" in caplog.text) == (
        not room,
        not room,
    )


def test_a_run_that_is_not_recorded_waits_for_no_disk_longer_than_that(slow: Desk) -> None:
    slow.post(BeginEpisode(2, None))
    slow.pump()
    slow.clock.advance(1.01)
    slow.pump()
    (opened,) = slow.told(EpisodeOpened)
    assert (opened.run, opened.error) == (2, "")


def test_at_the_end_of_the_process_the_last_episode_is_waited_for_but_not_for_ever(
    slow: Desk, disk: SlowDisk, caplog: pytest.LogCaptureFixture
) -> None:
    slow.media.finish(0.01)
    assert "episode one was not closed within 0.01 s" in caplog.text
    disk.finish()
    slow.media.finish(10.0)
    assert [closed.uuid for closed in slow.told(EpisodeClosed)] == ["one"]


def test_a_thread_closes_while_the_caller_goes_on() -> None:
    let, desk = threading.Event(), Desk(in_background)
    end = desk.journal.end

    def waiting(outcome: Any) -> None:
        assert let.wait(PATIENCE_S)
        end(outcome)

    desk.journal.end = waiting  # type: ignore[method-assign]
    desk.receive(1)
    desk.begin()
    desk.media.end("interrupted", "because")
    assert not desk.media.recording
    assert desk.told(EpisodeClosed) == []
    let.set()
    desk.media.finish(10.0)
    assert [(c.status, c.reason) for c in desk.told(EpisodeClosed)] == [("interrupted", "because")]


def test_an_error_of_our_own_while_closing_ends_media_as_it_would_anywhere() -> None:
    desk = Desk(in_background)
    desk.receive(1)
    desk.begin()

    def broken(outcome: Any) -> None:
        raise ZeroDivisionError("a mistake")

    desk.journal.end = broken  # type: ignore[method-assign]
    with pytest.raises(ZeroDivisionError, match="a mistake"):  # noqa: PT012  # whichever comes first
        desk.media.end("finished", "over")
        desk.media.finish(10.0)


# --- what was left open ------------------------------------------------------------------------------------


def left(root: Path, name: str, station: str = "bench") -> Path:
    """The folder of an episode that was begun and not closed; its manifest is none that can be repaired."""
    folder = root / name
    folder.mkdir(parents=True)
    (folder / "manifest.json").write_text(json.dumps({"station": station}), "utf-8")
    return folder


def test_only_folders_without_an_outcome_are_left_over(tmp_path: Path) -> None:
    (left(tmp_path, "closed") / "outcome.json").write_text("{}", "utf-8")
    (tmp_path / "no episode").mkdir()
    left_open = left(tmp_path, "open")
    assert find_open_episodes(tmp_path) == [left_open]
    assert find_open_episodes(tmp_path / "nothing was ever recorded") == []


@pytest.mark.parametrize("error", [RecordingError("disk full"), ZeroDivisionError("a mistake")])
def test_a_leftover_that_cannot_be_repaired_keeps_no_other_from_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, error: Exception
) -> None:
    seen: list[str] = []

    def repaired(folder: Path) -> RepairReport:
        seen.append(folder.name)
        if folder.name == "bad":
            raise error
        return RepairReport(folder, "repaired", frames=7)

    monkeypatch.setattr("runtime.processes.media.crash_repair.repair", repaired)
    folders = [left(tmp_path, "bad"), left(tmp_path, "foreign", "bench-2"), left(tmp_path, "good")]
    repair_open_episodes(folders, "bench")
    assert seen == ["bad", "good"]
    assert "episode bad was left open and stays as it is" in caplog.text
    assert str(error) in caplog.text
    assert "episode good was left open: repaired, 7 rows" in caplog.text


def test_ending_without_an_episode_says_nothing(desk: Desk) -> None:
    desk.media.end("interrupted", "nobody home")
    assert desk.told(EpisodeClosed) == []


TRUTH = {"reset": "r", "milestones": {"placed": True}, "success": True}


def test_the_truth_of_a_simulated_bench_is_reported_and_forgotten_with_its_node(desk: Desk) -> None:
    desk.source.waiting.append(desk.observation(1, truth=TRUTH))
    desk.pump()
    assert desk.told(ReceptionReport)[-1].truth == TRUTH
    desk.clock.advance(1.0)
    desk.receive(2)  # another node, or the same without its bench
    assert desk.told(ReceptionReport)[-1].truth == {}


def test_an_episode_ends_with_the_newest_truth(desk: Desk) -> None:
    desk.receive(1)
    desk.begin()
    desk.source.waiting.append(desk.observation(2, truth=TRUTH))
    desk.pump()
    desk.post(EndEpisode("finished", "stopped", {"reached": {"grasped": 1.5}}))
    desk.pump()
    said = [event for event in desk.told(Event) if event.kind == "truth"]
    assert [event.data for event in said] == [TRUTH | {"reached": {"grasped": 1.5}, "episode": "one"}]
    assert [event["data"] for event in desk.journal.events if event["kind"] == "truth"] == [said[0].data]
    assert desk.journal.outcome is not None


def test_without_truth_nothing_is_said_of_it(desk: Desk) -> None:
    desk.receive(1)
    desk.begin()
    desk.post(EndEpisode("finished", "stopped"))
    desk.pump()
    assert [event for event in desk.told(Event) if event.kind == "truth"] == []


def test_a_log_that_cannot_take_the_truth_ends_the_episode_once(desk: Desk) -> None:
    desk.receive(1)
    desk.begin()
    desk.source.waiting.append(desk.observation(2, truth=TRUTH))
    desk.pump()

    desk.journal.failing = {"mark"}
    desk.post(EndEpisode("finished", "stopped"))
    desk.pump()
    closed = desk.told(EpisodeClosed)
    assert [(message.status, message.reason) for message in closed] == [("failed", "disk full while mark")]


def test_drives_are_reported_and_their_changes_are_events_of_the_episode(desk: Desk) -> None:
    desk.receive(1)
    assert desk.told(ReceptionReport)[-1].drives == {}
    desk.begin()
    off = {"enabled": False, "faults": ["axis 2 is hot"]}
    for sequence in (2, 3):
        desk.source.waiting.append(desk.observation(sequence, drives=off))
        desk.clock.advance(1.0)
        desk.pump()
    messages = desk.heard()
    events = [m for m in messages if isinstance(m, Event) and m.kind == "drives"]
    assert [(e.text, e.data) for e in events] == [("drives disabled; drive fault: axis 2 is hot", off)]
    assert [m.drives for m in messages if isinstance(m, ReceptionReport)][-1] == off
    assert [event["kind"] for event in desk.journal.events] == ["drives"]


# --- what is made of closed episodes -----------------------------------------------------------------------


def test_an_episode_on_disk_is_passed_on_once_after_main_was_told() -> None:
    desk = Desk()
    desk.receive(1)
    desk.begin()
    desk.media.end("finished", "over")
    desk.media.poll()
    assert desk.on_disk == [Path("/episodes/one")]
    assert len(desk.told(EpisodeClosed)) == 1


def test_a_leftover_that_was_repaired_is_passed_on_and_a_broken_one_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def repair(folder: Path) -> RepairReport:
        return RepairReport(folder, "unreadable" if folder.name == "bad" else "repaired")

    monkeypatch.setattr("runtime.processes.media.crash_repair.repair", repair)
    heard: list[Path] = []
    repair_open_episodes([left(tmp_path, "bad"), left(tmp_path, "good")], "bench", heard.append)
    assert heard == [tmp_path / "good"]
