import contextlib
import errno
import json
import os
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runtime.core.errors import RecordingError
from runtime.recording.base import LostCamera, Outcome
from runtime.recording.episode import EpisodeJournal
from runtime.recording.files import DiskFullError, UnclosedError
from runtime.recording.fragments import count_frames
from runtime.recording.reader import open_episode
from runtime.recording.repair import repair
from runtime.recording.settings import RecordingSettings
from runtime.recording.video import FragmentedVideo
from tests.processes import PATIENCE_S, eventually
from tests.runtime.recording.failing import fail_at

from .samples import CAMERAS, HEIGHT, SETTINGS, WIDTH, chunk, manifest, numbers, row, tick, unended

FINISHED = Outcome("finished", "stopped by the operator", 1.7e9 + 10, {"success": True, "frames": "mine"})


def begun(root: Path, settings: RecordingSettings = SETTINGS, **options: Any) -> tuple[EpisodeJournal, Path]:
    journal = EpisodeJournal(root, settings, **options)
    journal.begin(manifest())
    assert journal.folder is not None
    return journal, journal.folder


def small(**changes: Any) -> RecordingSettings:
    return SETTINGS.model_copy(update=changes)


class Stuck:
    """An encoder that stands still at one camera until it is let go."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, camera: str) -> None:
        self.free = threading.Event()
        real = FragmentedVideo.encode

        def encode(video: FragmentedVideo, picture: np.ndarray | None) -> None:
            if threading.current_thread().name == f"encoder {camera}":
                self.free.wait(PATIENCE_S)
            real(video, picture)

        monkeypatch.setattr(FragmentedVideo, "encode", encode)


def refuse(monkeypatch: pytest.MonkeyPatch, name: str, code: int = errno.ENOSPC) -> None:
    """Let writes to files of that name fail."""
    real = os.write

    def write(descriptor: int, data: Any) -> int:
        if os.readlink(f"/proc/self/fd/{descriptor}").endswith(name):
            raise OSError(code, os.strerror(code))
        return real(descriptor, data)

    monkeypatch.setattr(os, "write", write)


def append_for_ever(journal: EpisodeJournal) -> None:
    for k in range(100_000):
        journal.append(row(k))
        journal.append(tick(k))
        journal.append_event({"k": k})


def fill(path: Path) -> None:
    """Take all the room that is left on a disk."""
    with open(path, "wb") as file:
        while True:
            file.write(bytes(4096))
            file.flush()


def test_a_whole_episode_comes_back(tmp_path: Path) -> None:
    journal, folder = begun(tmp_path / "episodes")
    given = json.loads((folder / "manifest.json").read_text())
    assert folder.name == given["uuid"]
    journal.append_event({"kind": "started", "delay": np.float64(0.5)})
    for k in range(40):
        journal.append(row(k, control_source="hold" if k >= 30 else "policy"))
        journal.append(tick(3 * k))
        journal.append(tick(3 * k + 1, smoothed=None))
    journal.append(chunk(1))
    journal.append_event({"kind": "stopped"})
    journal.end(FINISHED)
    assert journal.folder is None
    episode = open_episode(folder)
    assert episode.manifest == given
    assert episode.frames == 40
    assert episode.rows.column("index").to_pylist() == list(range(40))
    assert [numbers(episode.videos[camera]) for camera in CAMERAS] == [list(range(1, 41))] * 2
    assert (episode.ticks.num_rows, episode.smoothed.num_rows, episode.raw.num_rows) == (80, 40, 4)
    assert episode.events == ({"kind": "started", "delay": 0.5}, {"kind": "stopped"})
    outcome = dict(episode.outcome or {})
    muxed = outcome.pop("muxed_ms")
    assert sorted(muxed) == sorted(CAMERAS)
    assert all(taken["p50"] <= taken["p99"] <= taken["max"] for taken in muxed.values())
    assert outcome == {
        "success": True,
        "status": "finished",
        "reason": "stopped by the operator",
        "ended_wall": 1.7e9 + 10,
        "frames": 40,
        "duration_s": pytest.approx(1.0),
        "held_rows": 10,
        "repeated": dict.fromkeys(CAMERAS, 0),
        "lost": dict.fromkeys(CAMERAS, 0),
        "stale": dict.fromkeys(CAMERAS, 0),
        "skewed_rows": 0,
        "lost_cameras": {},
        "skew": {"mean_s": pytest.approx(0.02), "max_s": pytest.approx(0.02)},
        "rows": 40,
        "video_frames": dict.fromkeys(CAMERAS, 40),
    }


def test_the_manifest_is_there_before_the_first_row(tmp_path: Path) -> None:
    journal, folder = begun(tmp_path)
    episode = open_episode(folder)
    assert episode.outcome is None
    assert episode.frames == 0
    journal.end(FINISHED)


def test_unknown_keys_of_the_manifest_are_kept(tmp_path: Path) -> None:
    journal = EpisodeJournal(tmp_path, SETTINGS)
    given = manifest(operator="ada", scene={"name": "table"})
    journal.begin(given)
    journal.end(FINISHED)
    assert open_episode(tmp_path / given["uuid"]).manifest == given


def test_one_journal_writes_episode_after_episode(tmp_path: Path) -> None:
    journal = EpisodeJournal(tmp_path, SETTINGS)
    for _ in range(2):
        journal.begin(manifest())
        journal.append(row(0))
        journal.end(FINISHED)
    assert [open_episode(folder).frames for folder in tmp_path.iterdir()] == [1, 1]


def test_an_episode_is_never_written_twice(tmp_path: Path) -> None:
    journal = EpisodeJournal(tmp_path, SETTINGS)
    given = manifest()
    journal.begin(given)
    journal.append(row(0))
    journal.end(FINISHED)
    with pytest.raises(RecordingError, match=f"{given['uuid']} exists already"):
        journal.begin(given)
    assert open_episode(tmp_path / given["uuid"]).frames == 1


def test_begin_and_end_come_in_turns(tmp_path: Path) -> None:
    journal = EpisodeJournal(tmp_path, SETTINGS)
    for call in (
        lambda: journal.append(row(0)),
        lambda: journal.append_event({}),
        lambda: journal.end(FINISHED),
    ):
        with pytest.raises(RecordingError, match="no episode has begun"):
            call()
    journal.begin(manifest())
    with pytest.raises(RecordingError, match="has not ended"):
        journal.begin(manifest())
    journal.end(FINISHED)


def opened_in(folder: Path) -> list[str]:
    """The files in a folder, deleted ones too, that this process holds open."""
    held = []
    for descriptor in os.listdir("/proc/self/fd"):
        with contextlib.suppress(FileNotFoundError):  # closed meanwhile: that of the listing itself, for one
            held.append(os.readlink(f"/proc/self/fd/{descriptor}"))
    return [file for file in held if file.startswith(f"{folder}/")]


def test_a_begin_that_fails_leaves_nothing_behind(tmp_path: Path) -> None:
    journal = EpisodeJournal(tmp_path, SETTINGS)
    threads = set(threading.enumerate())
    sizes = {CAMERAS[0]: {"width": WIDTH, "height": HEIGHT}, CAMERAS[1]: {"width": 65536, "height": 2}}
    with pytest.raises(RecordingError, match=f"camera {CAMERAS[1]}: no encoder"):
        journal.begin(manifest(cameras=sizes))
    assert list(tmp_path.iterdir()) == []
    assert set(threading.enumerate()) <= threads
    assert opened_in(tmp_path) == []
    journal.begin(manifest())
    journal.end(FINISHED)


def test_too_little_room_refuses_to_begin(tmp_path: Path) -> None:
    journal = EpisodeJournal(tmp_path, small(min_free_bytes=1 << 60))
    with pytest.raises(RecordingError, match=f"at least {1 << 60} wanted"):
        journal.begin(manifest())
    assert list(tmp_path.iterdir()) == []


def test_a_refused_row_leaves_rows_and_frames_together(tmp_path: Path) -> None:
    journal, folder = begun(tmp_path)
    journal.append(row(0))
    wrong = {CAMERAS[0]: row(1).pictures[CAMERAS[0]], CAMERAS[1]: np.zeros((8, 8, 3), np.uint8)}
    with pytest.raises(RecordingError, match="wrist gave uint8"):
        journal.append(row(1, pictures=wrong))
    journal.append(row(1))
    journal.end(FINISHED)
    episode = open_episode(folder)
    assert episode.frames == 2
    assert [numbers(video) for video in episode.videos.values()] == [[1, 2], [1, 2]]


def test_a_missing_picture_repeats_the_last_one_and_is_flagged(tmp_path: Path) -> None:
    journal, folder = begun(tmp_path)
    for k in range(6):
        pictures = dict(row(k).pictures)
        if k in (0, 3):
            pictures[CAMERAS[0]] = None
        journal.append(row(k, pictures=pictures))
    journal.end(FINISHED)
    episode = open_episode(folder)
    assert numbers(episode.videos[CAMERAS[0]]) == [0, 2, 3, 3, 5, 6]
    assert numbers(episode.videos[CAMERAS[1]]) == [1, 2, 3, 4, 5, 6]
    flags = episode.rows.column(f"repeated.{CAMERAS[0]}").to_pylist()
    assert flags == [True, False, False, True, False, False]
    assert episode.outcome is not None
    assert episode.outcome["repeated"] == {CAMERAS[0]: 2, CAMERAS[1]: 0}


def test_an_encoder_that_falls_behind_costs_flagged_repeats_and_no_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stuck = Stuck(monkeypatch, CAMERAS[0])
    journal, folder = begun(tmp_path, small(queue_frames=3, give_up_s=10.0))
    for k in range(100):
        journal.append(row(k, pictures={**row(k).pictures, CAMERAS[1]: None}))
    stuck.free.set()
    journal.end(FINISHED)
    episode = open_episode(folder)
    flags = episode.rows.column(f"repeated.{CAMERAS[0]}").to_pylist()
    shown = numbers(episode.videos[CAMERAS[0]])
    assert len(shown) == episode.frames == 100
    assert 96 <= sum(flags) <= 97  # three wait, and one may be in the encoder's hands
    assert flags == episode.rows.column(f"lost.{CAMERAS[0]}").to_pylist()
    assert not any(episode.rows.column(f"lost.{CAMERAS[1]}").to_pylist())
    for k in range(100):
        assert shown[k] == (shown[k - 1] if flags[k] else k + 1)


def test_a_patient_journal_repeats_nothing(tmp_path: Path) -> None:
    journal, folder = begun(tmp_path, small(queue_frames=1), patient=True)
    for k in range(200):
        journal.append(row(k))
    journal.end(FINISHED)
    episode = open_episode(folder)
    assert episode.outcome is not None
    assert episode.outcome["repeated"] == dict.fromkeys(CAMERAS, 0)
    assert numbers(episode.videos[CAMERAS[1]]) == list(range(1, 201))


def append_until_lost(journal: EpisodeJournal) -> tuple[int, LostCamera]:
    """Append rows until a camera is said to be lost; how many, and the loss."""
    for k in range(10_000):
        journal.append(row(k))
        losses = journal.pop_lost_cameras()
        if losses:
            assert len(losses) == 1
            return k + 1, losses[0]
    raise AssertionError("no camera was lost")


def test_a_failing_encoder_costs_its_video_and_all_else_is_recorded_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fail_at(monkeypatch, CAMERAS[0], 20, ValueError("lost its mind"))
    journal, folder = begun(tmp_path, patient=True)
    told, loss = append_until_lost(journal)
    for k in range(told, told + 30):
        journal.append(row(k))
        journal.append(tick(k))
    assert journal.pop_lost_cameras() == []
    journal.end(FINISHED)
    assert (loss.camera, loss.row) == (CAMERAS[0], 20)
    assert f"camera {CAMERAS[0]}: the encoder failed" in loss.text
    assert "lost its mind" in loss.text
    episode = open_episode(folder)
    assert episode.frames == told + 30
    assert numbers(episode.videos[CAMERAS[1]]) == list(range(1, told + 31))
    assert numbers(episode.videos[CAMERAS[0]]) == list(range(1, 21))
    assert [(event["kind"], event["text"], event["data"]) for event in episode.events] == [
        ("video_lost", loss.text, {"camera": CAMERAS[0], "row": 20})
    ]
    flags = episode.rows.column(f"lost.{CAMERAS[0]}").to_pylist()
    assert all(flags[told:])
    assert not any(flags[:20])
    assert not any(episode.rows.column(f"lost.{CAMERAS[1]}").to_pylist())
    outcome = episode.outcome or {}
    assert outcome["status"] == "finished"
    assert outcome["reason"] == f"stopped by the operator; {loss.text}"
    assert outcome["lost_cameras"] == {CAMERAS[0]: {"row": 20, "reason": loss.reason}}
    assert outcome["video_frames"] == {CAMERAS[0]: 20, CAMERAS[1]: told + 30}
    assert outcome["lost"][CAMERAS[0]] == sum(flags)


def test_a_video_that_cannot_be_written_costs_itself_and_all_else_is_recorded_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal, folder = begun(tmp_path, patient=True)
    refuse(monkeypatch, f"{CAMERAS[1]}.mp4", errno.EIO)
    told, loss = append_until_lost(journal)
    journal.end(FINISHED)
    monkeypatch.undo()
    assert loss.camera == CAMERAS[1]
    assert "disk error while writing" in loss.reason
    episode = open_episode(folder)
    assert episode.outcome is not None
    assert episode.outcome["status"] == "finished"
    assert episode.outcome["lost_cameras"][CAMERAS[1]]["row"] == 0
    assert numbers(episode.videos[CAMERAS[0]]) == list(range(1, told + 1))


def test_an_episode_whose_every_camera_is_lost_keeps_its_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(video: FragmentedVideo, picture: np.ndarray | None) -> None:
        raise ValueError("no encoder any more")

    monkeypatch.setattr(FragmentedVideo, "encode", failing)
    journal, folder = begun(tmp_path)
    for k in range(50):
        journal.append(row(k))
    journal.end(FINISHED)
    assert sorted(loss.camera for loss in journal.pop_lost_cameras()) == sorted(CAMERAS)
    episode = open_episode(folder)
    assert episode.frames == 50
    assert sorted(episode.outcome["lost_cameras"]) == sorted(CAMERAS)  # type: ignore[index]


def test_repair_keeps_the_rows_after_a_camera_was_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fail_at(monkeypatch, CAMERAS[0], 20, ValueError("lost its mind"))
    journal, folder = begun(tmp_path, patient=True)
    told, loss = append_until_lost(journal)
    for k in range(told, told + 30):
        journal.append(row(k))
    journal.end(FINISHED)
    unended(folder)
    report = repair(folder)
    assert (report.verdict, report.frames, report.rows_cut) == ("repaired", told + 30, 0)
    outcome = open_episode(folder).outcome or {}
    assert outcome["lost_cameras"] == {CAMERAS[0]: {"row": 20, "reason": loss.text}}


def test_an_encoder_that_never_ends_is_named_and_the_episode_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stuck = Stuck(monkeypatch, CAMERAS[0])
    journal, folder = begun(tmp_path, small(drain_timeout_s=0.1))
    for k in range(5):
        journal.append(row(k))
    journal.end(FINISHED)
    (loss,) = journal.pop_lost_cameras()
    stuck.free.set()
    assert f"camera {CAMERAS[0]}: the encoder did not end in time" in loss.reason
    episode = open_episode(folder)
    assert episode.frames == 5
    assert episode.outcome is not None
    assert episode.outcome["status"] == "finished"
    assert episode.outcome["reason"].startswith("stopped by the operator; camera")
    assert episode.outcome["lost_cameras"][CAMERAS[0]]["row"] == 0
    assert numbers(episode.videos[CAMERAS[1]]) == [1, 2, 3, 4, 5]


def test_an_encoder_that_stands_still_is_given_up_while_all_else_is_recorded_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stuck = Stuck(monkeypatch, CAMERAS[0])
    journal, folder = begun(tmp_path, small(give_up_s=1.0, queue_frames=2))
    assert journal._recording is not None
    healthy = journal._recording._encoders[CAMERAS[1]]._queue
    for k in range(60):
        eventually(lambda: healthy.waiting() < 10, "the other camera keeps up")  # else it is given up too
        journal.append(row(k, pictures={**row(k).pictures, CAMERAS[1]: None}))
    (loss,) = journal.pop_lost_cameras()
    assert loss.camera == CAMERAS[0]
    assert "is given up" in loss.reason
    stuck.free.set()
    journal.end(FINISHED)
    episode = open_episode(folder)
    assert episode.frames == 60
    assert (
        episode.rows.column(f"lost.{CAMERAS[0]}").to_pylist().count(False) <= 4
    )  # those that had begun to wait
    assert episode.outcome["status"] == "finished"  # type: ignore[index]


@pytest.mark.parametrize("name", ["rows.arrow", "ticks.arrow", f"{CAMERAS[1]}.mp4", "events.jsonl"])
def test_a_file_that_cannot_be_written_is_named_and_the_rest_stays_readable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    journal, folder = begun(tmp_path, patient=True)
    refuse(monkeypatch, name)
    with pytest.raises(RecordingError, match="disk full while writing") as raised:
        append_for_ever(journal)
    assert name in str(raised.value)
    assert "bytes free in" in str(raised.value)
    with pytest.raises(UnclosedError, match="disk full while writing") as waits:
        journal.end(Outcome("failed", str(raised.value), 1.7e9))
    with pytest.raises(UnclosedError, match="disk full while writing"):
        waits.value.again()
    assert not (folder / "outcome.json").exists()
    assert repair(folder).verdict == "recording"  # nobody else meddles with what is still held
    monkeypatch.undo()
    waits.value.again()
    episode = open_episode(folder)
    assert episode.outcome is not None
    assert episode.outcome["status"] == "failed"
    assert 0 < episode.frames == min(episode.outcome["video_frames"].values())  # type: ignore[attr-defined]
    assert numbers(episode.videos[CAMERAS[0]]) == list(range(1, count_frames(episode.videos[CAMERAS[0]]) + 1))


def test_a_fault_found_only_at_the_end_is_raised_by_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal, folder = begun(tmp_path, small(flush_period_s=1.0))
    journal.append(row(0))
    refuse(monkeypatch, "rows.arrow", errno.EIO)
    with pytest.raises(RecordingError, match=r"disk error while writing .*rows\.arrow"):
        journal.end(FINISHED)
    monkeypatch.undo()
    assert open_episode(folder).outcome["status"] == "failed"  # type: ignore[index]


@pytest.mark.exhaustive
def test_a_disk_that_is_really_full_is_named_and_what_was_written_stays_readable(small_disk: Path) -> None:
    journal, folder = begun(small_disk / "episodes", patient=True)
    ballast = small_disk / "ballast"
    ballast.write_bytes(bytes(700_000))
    with pytest.raises(RecordingError, match="disk full while writing") as raised:
        append_for_ever(journal)
    assert str(folder) in str(raised.value)
    ballast.unlink()
    journal.end(Outcome("failed", str(raised.value), 1.7e9))
    episode = open_episode(folder)
    assert episode.frames > 0
    assert episode.rows.column("index").to_pylist() == list(range(episode.frames))
    for video in episode.videos.values():
        assert numbers(video)[: episode.frames] == list(range(1, episode.frames + 1))


def test_an_end_that_finds_no_room_is_whole_once_there_is_some(small_disk: Path) -> None:
    journal, folder = begun(small_disk, patient=True)
    for k in range(60):
        journal.append(row(k))
        journal.append_event({"k": k})
    ballast = small_disk / "ballast"
    with pytest.raises(OSError, match="No space"):
        fill(ballast)
    with pytest.raises(UnclosedError, match="disk full while writing") as waits:
        journal.end(FINISHED)
    assert not (folder / "outcome.json").exists()
    second, other = begun(small_disk.parent)  # another disk, or later: one that waits is in nobody's way
    second.append(row(0))
    second.end(FINISHED)
    ballast.unlink()
    waits.value.again()
    assert open_episode(other).frames == 1
    episode = open_episode(folder)
    assert episode.outcome is not None
    assert (episode.outcome["status"], episode.frames, len(episode.events)) == ("finished", 60, 60)
    for video in episode.videos.values():
        assert numbers(video) == list(range(1, 61))


def test_an_outcome_that_alone_finds_no_room_is_written_once_there_is_some(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal, folder = begun(tmp_path)
    journal.append(row(0))

    def full(path: Path, data: bytes) -> None:
        raise DiskFullError(f"disk full while writing {path}")

    monkeypatch.setattr("runtime.recording.outcome_seal.write_atomic", full)
    with pytest.raises(UnclosedError, match=r"disk full while writing .*sealed\.json") as waits:
        journal.end(FINISHED)
    monkeypatch.undo()
    waits.value.again()
    assert open_episode(folder).outcome["status"] == "finished"  # type: ignore[index]
    assert repair(folder).verdict == "complete"


def test_something_that_is_no_record_is_refused(tmp_path: Path) -> None:
    journal, _ = begun(tmp_path)
    with pytest.raises(RecordingError, match="not dict"):
        journal.append({"index": 0})  # type: ignore[arg-type]
    with pytest.raises(RecordingError, match="an event cannot be written"):
        journal.append_event({"what": object()})
    journal.end(FINISHED)
