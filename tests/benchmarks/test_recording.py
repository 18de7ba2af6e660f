"""How the recording benchmark judges a recording, a kill, and writers beside each other."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any
from uuid import UUID, uuid4

import numpy as np
import pyarrow as pa
import pytest
from django.db import connection

from benchmarks import __main__ as command_line
from benchmarks import recording_busy
from benchmarks.recording import figures
from benchmarks.recording_kills import RUNNING, _loss
from benchmarks.recording_pace import Frames, feed_frames, finish
from benchmarks.recording_station import lost, published, to_disk
from evaweb.jobs.models import Job, JobStatus
from runtime.recording.base import Outcome
from runtime.recording.episode import EpisodeJournal
from runtime.recording.reader import Episode, open_episode
from tests.runtime.recording.samples import CAMERAS, SETTINGS, manifest, row, tick

CAMERA = "cam"
STARTED = 500.0


def episode(captured: list[float], repeated: list[bool], **changes: Any) -> Any:
    count = len(captured)
    columns = {
        "tick_time": np.arange(count) / 30.0,
        "sequence": np.arange(count),
        f"capture_time.{CAMERA}": captured,
        f"repeated.{CAMERA}": repeated,
        **changes.get("columns", {}),
    }
    return SimpleNamespace(
        rows=pa.table(columns),
        layout=SimpleNamespace(fps=30.0, cameras={CAMERA: (48, 64)}, uuid="u"),
        outcome={"video_frames": {CAMERA: changes.get("frames", count)}, "status": "interrupted"},
        manifest={"started_monotonic": STARTED},
        frames=count,
        path=Path("episode"),
    )


def recorded(root: Path, rows: int) -> Episode:
    journal = EpisodeJournal(root, SETTINGS, patient=True)
    journal.begin(told := manifest())
    for index in range(rows):
        journal.append(row(index))
        journal.append(tick(index))
    journal.end(Outcome("finished", "done", 1.7e9))
    return open_episode(root / told["uuid"])


def test_a_repeat_is_a_loss_only_where_the_row_had_a_new_picture() -> None:
    found = lost(episode([0.0, 0.03, 0.03, 0.09], [False, False, True, True]))
    assert (found["frames_lost"], found["grid_repeats"]) == (1, 1)


def test_a_missing_row_and_a_short_video_are_losses_and_skipped_pictures_are_not() -> None:
    gap = {"tick_time": np.array([0, 1, 3]) / 30.0, "sequence": [0, 1, 4]}
    found = lost(episode([0.0, 0.03, 0.1], [False] * 3, columns=gap))
    assert (found["frames_lost"], found["grid_skips"]) == (1, 2)
    assert lost(episode([0.0, 0.03, 0.1], [False] * 3, frames=1))["frames_lost"] == 2


def test_a_picture_that_is_not_in_the_video_is_silent_where_no_row_says_so() -> None:
    made = episode([0.0, 0.03, 0.03, 0.06, 0.09], [False, True, True, True, True])
    flags = pa.array([False, False, False, True, False])
    rows = made.rows.append_column(f"lost.{CAMERA}", flags)
    found = recording_busy.pictures(SimpleNamespace(rows=rows, layout=made.layout))  # type: ignore[arg-type]
    assert found == {"rows": 5, "lost": 1, "silent": 2}


def test_the_loss_of_a_kill_is_from_the_end_of_the_last_row() -> None:
    whole = episode([0.0] * 31, [False] * 31)
    assert _loss(whole, STARTED + 1.0 + 1 / 30)["lost_s"] == pytest.approx(0.0, abs=1e-9)
    assert _loss(whole, STARTED + 1.5 + 1 / 30)["lost_s"] == pytest.approx(0.5)
    assert _loss(whole, STARTED)["lost_s"] == 0.0
    assert _loss(episode([], []), STARTED + 2.0)["lost_s"] == pytest.approx(2.0), "nothing is left"


def test_a_frame_is_on_disk_when_the_file_was_seen_to_hold_it(tmp_path: Path) -> None:
    made = recorded(tmp_path, 10)
    started = float(made.manifest["started_monotonic"])  # type: ignore[arg-type]
    sizes = {
        camera: [(started, 0), (started + 2.0, path.stat().st_size)] for camera, path in made.videos.items()
    }
    captured = made.rows.column(f"capture_time.{CAMERAS[0]}").to_numpy()
    found = to_disk(made, {video.stem: sizes[camera] for camera, video in made.videos.items()})
    assert found["max"] == pytest.approx((2.0 - captured.min()) * 1000.0, abs=1.0)
    never = {video.stem: [(started, 0)] for video in made.videos.values()}
    with pytest.raises(SystemExit, match="no frame"):
        to_disk(made, never)


def test_publication_that_codes_nothing_anew_changes_no_frame(tmp_path: Path) -> None:
    made = recorded(tmp_path, 60)
    found = published(made.path, tmp_path / "dataset", made.frames)
    assert found["publish_changed_frames"] == 0
    assert found["publish_s"] > 0


def test_frames_go_to_and_fro_and_every_writer_is_given_all(tmp_path: Path) -> None:
    pictures = np.arange(4, dtype=np.uint8).reshape(4, 1, 1, 1, 1) * np.ones((1, 3, 2, 2, 3), np.uint8)
    np.save(tmp_path / "frames.npy", pictures)
    frames = Frames(tmp_path / "frames.npy")
    assert [int(frames(index)["cam_high"][0, 0, 0]) for index in range(8)] == [0, 1, 2, 3, 2, 1, 0, 1]
    taken: list[int] = []
    given = feed_frames(frames, 5, lambda index, seen: taken.append(index))
    written = finish(given, lambda: None, tmp_path)
    assert taken == [0, 1, 2, 3, 4]
    assert (written.frames, written.bytes) == (5, (tmp_path / "frames.npy").stat().st_size)


def parts(**changes: Any) -> Any:
    station = {
        "frames_lost": 0,
        "cpu_core_percent": 40.0,
        "cpu_core_percent_reception": 8.0,
        "cpu_core_percent_not_recording": 10.0,
        "memory_mb": {"before": 90.0, "start": 100.0, "end": 110.0, "peak": 120.0},
        "to_disk_ms": {"p50": 100.0},
        "stop_to_saved_s": 0.3,
        "publish_s": 1.0,
        "publish_changed_frames": 0,
    } | changes
    busy = [
        {
            "case": case,
            "age_ms": {"p99": changes.get("age", 20.0)},
            "holds": changes.get("holds", []),
            "lost": 7,
        }
        | {"silent": changes.get("silent", 0)}
        for case in recording_busy.CASES
    ]
    beside = [
        {"writer": "ours", "capture_cpu_s": 3.0, "save_cpu_s": 1.0, "save_s": 0.5, "frames": 100},
        {"writer": "lerobot", "capture_cpu_s": 10.0, "save_cpu_s": 10.0, "save_s": 5.0, "frames": 100},
    ]
    kills = [
        {"process": "media", "after_s": 1.0, "lost_s": changes.get("lost_s", 0.4)},
        {"process": "worker", "after_s": None, "lost_s": 0.0, "problems": changes.get("problems", [])},
    ]
    listing = [
        {"median_ms": 20.0, "processor_ms": 10.0},
        {"median_ms": changes.get("listing", 60.0), "processor_ms": 30.0},
    ]
    made = figures(station, {"rows": busy}, {"rows": beside}, {"rows": kills}, {"rows": listing})
    return {figure.name: figure for figure in made}


def test_every_figure_that_is_wanted_can_be_missed() -> None:
    good = parts()
    assert {name for name, figure in good.items() if figure.holds is False} == set()
    assert good["memory_growth_mb"].value == 20.0
    assert (good["cpu_ratio.lerobot"].value, good["save_ratio.lerobot"].value) == (5.0, 10.0)
    assert (good["kill9_kills"].value, good["list_10000_ms"].value) == (1, 60.0)
    bad = parts(
        frames_lost=1,
        cpu_core_percent=51.0,
        memory_mb={"before": 0.0, "start": 1.0, "end": 2.0, "peak": 52.0},
        stop_to_saved_s=1.1,
        publish_changed_frames=1,
        lost_s=1.1,
        problems=["gone"],
        listing=201.0,
        age=61.0,
        holds=["joints are 0.21 s old"],
        silent=1,
    )
    wanted = {name for name, figure in good.items() if figure.wanted}
    assert {name for name, figure in bad.items() if figure.holds is False} == wanted


def test_long_is_refused_where_there_is_nothing_longer(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["benchmarks", "ik", "--long"])
    with pytest.raises(SystemExit):
        command_line.main()
    assert "--long is for chaos and designs and peers_sim and recording" in capsys.readouterr().err


@pytest.mark.django_db
def test_the_killer_of_workers_finds_a_job_that_runs_and_whose_it_is() -> None:
    """The benchmark reads the table as it is, past Django."""
    owner = uuid4()
    Job.objects.create(kind="publish", key="mine", status=JobStatus.RUNNING, owner=owner)
    Job.objects.create(kind="publish", key="waits")
    with connection.cursor() as cursor:
        found = cursor.execute(RUNNING).fetchall()
    assert [(key, UUID(str(uuid))) for key, uuid in found] == [("mine", owner)]
