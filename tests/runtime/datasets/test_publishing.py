from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import subprocess
import sys
import threading
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from runtime.core.errors import RecordingError
from runtime.datasets import layout, staging
from runtime.datasets.consistency import check
from runtime.datasets.mapping import ColumnMapping
from runtime.datasets.publishing import publish
from runtime.datasets.reader import open_dataset
from runtime.recording.base import Outcome
from runtime.recording.episode import EpisodeJournal
from runtime.recording.reader import open_episode
from runtime.recording.settings import RecordingSettings
from runtime.recording.video import FragmentedVideo
from tests.runtime.datasets.small import CAMERAS, JOINTS, manifest, picture, record, row, seen
from tests.runtime.recording.samples import unsealed
from tests.runtime.recording.test_tables import old_raw

CONFORMANCE = Path(__file__).parents[2] / "conformance"
WHOLE = ColumnMapping(
    eef="eef_state", velocity="joint_velocity", effort="joint_effort", action_eef="eef_action"
)


_readers: dict[str, subprocess.Popen[str]] = {}


@pytest.fixture(scope="module", autouse=True)
def _readers_end() -> Iterator[None]:
    yield
    for reader in _readers.values():
        reader.communicate()
    _readers.clear()


def _reader(version: str) -> subprocess.Popen[str]:
    """The program that reads that version; it waits for what to read."""
    if version not in _readers:
        script = CONFORMANCE / f"read_lerobot_{version.replace('.', '')}.py"
        _readers[version] = subprocess.Popen(
            [sys.executable, "-I", str(script)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
    return _readers[version]


def stranger(dataset: Path) -> dict[str, Any]:
    """What a program that knows only the format reads, in a process of its own."""
    reading = _reader(info(dataset)["codebase_version"])
    assert reading.stdin is not None
    assert reading.stdout is not None
    reading.stdin.write(f"{dataset}\n")
    reading.stdin.flush()
    report: dict[str, Any] = json.loads(reading.stdout.readline())
    return report


def info(dataset: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((dataset / "meta/info.json").read_text())
    return content


def table(dataset: Path, index: int = 0) -> Any:
    return pq.read_table(dataset / f"data/chunk-000/episode_{index:06d}.parquet")


def lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_rows_and_pictures_come_back_exactly(tmp_path: Path) -> None:
    done = publish(record(tmp_path / "episodes", frames=20), tmp_path / "set")
    assert (done.episode_index, done.frames, done.created) == (0, 20, True)
    episode = open_dataset(tmp_path / "set").episode(0, WHOLE)
    assert (episode.length, episode.fps, episode.task) == (20, 30.0, "stack the cups")
    for k in range(20):
        made = row(k)
        for stored, given in (
            (episode.qpos, made.qpos),
            (episode.action, made.action),
            (episode.qvel, made.qvel),
            (episode.effort, made.effort),
            (episode.eef, made.eef),
            (episode.action_eef, made.eef_action),
        ):
            assert stored is not None
            assert np.array_equal(stored[k], given)
    for camera in CAMERAS:
        with episode.pictures(camera) as pictures:
            assert [seen(pictures[k]) for k in range(20)] == list(range(20))
            assert len(pictures) == 20
    assert check(tmp_path / "set") == []


def test_a_program_that_knows_only_the_format_reads_the_same(tmp_path: Path) -> None:
    episodes = [record(tmp_path / "episodes", frames=n, seed=n) for n in (20, 7, 12)]
    for episode in episodes:
        publish(episode, tmp_path / "set")
    report = stranger(tmp_path / "set")
    assert report["broken"] == []
    assert (report["total_episodes"], report["total_frames"], report["fps"]) == (3, 39, 30)
    assert report["policy_outputs"] == ["action"]
    assert report["policy_inputs"] == ["observation.state", *(f"observation.images.{c}" for c in CAMERAS)]
    for read, n in zip(report["episodes"], (20, 7, 12), strict=True):
        rows = [row(k, seed=n) for k in range(n)]
        assert (read["length"], read["tasks"]) == (n, ["stack the cups"])
        assert read["sums"]["observation.state"] == pytest.approx(
            float(sum(r.qpos.sum() for r in rows)), abs=1e-4
        )
        assert read["sums"]["action"] == pytest.approx(float(sum(r.action.sum() for r in rows)), abs=1e-4)
        for camera in CAMERAS:
            expected = [float(picture(k).mean()) for k in range(n)]
            assert read["brightness"][f"observation.images.{camera}"] == pytest.approx(expected, abs=2)


def test_the_columns_are_named_and_typed_as_declared(tmp_path: Path) -> None:
    publish(record(tmp_path / "episodes"), tmp_path / "set")
    features = info(tmp_path / "set")["features"]
    assert features["observation.state"]["names"] == list(JOINTS)
    assert features["observation.images.cam_high"]["info"]["video.codec"] == "h264"
    stored = [key for key, feature in features.items() if feature["dtype"] != "video"]
    assert table(tmp_path / "set").column_names == stored
    assert {k: features[k]["dtype"] for k in ("capture_time.joints", "control_source", "intervention")} == {
        "capture_time.joints": "float64",
        "control_source": "string",
        "intervention": "bool",
    }
    assert "next.success" not in features


def test_times_of_capture_and_flags_are_kept(tmp_path: Path) -> None:
    publish(record(tmp_path / "episodes", frames=5), tmp_path / "set")
    read = table(tmp_path / "set")
    high, wrist = (read[f"capture_time.{c}"].to_numpy() for c in CAMERAS)
    assert np.allclose(high, 0.49 + np.arange(5) / 30)
    assert np.flatnonzero(np.isnan(wrist)).tolist() == [1]
    assert read["control_source"].to_pylist() == ["hold", *["policy"] * 4]
    assert read["next.done"].to_pylist() == [False] * 4 + [True]
    assert read["eef_action_reported"].to_pylist() == [True, False, True, False, True]
    assert read["repeated.cam_high"].to_pylist() == [False] * 5
    statistic = lines(tmp_path / "set/meta/episodes_stats.jsonl")[0]["stats"]["capture_time.cam_wrist"]
    assert statistic["count"] == [4]


def test_timestamps_are_the_float32_of_frame_over_fps(tmp_path: Path) -> None:
    publish(record(tmp_path / "episodes", frames=20, fps=24.0), tmp_path / "set")
    stamps = table(tmp_path / "set")["timestamp"].to_numpy()
    assert stamps.dtype == np.float32
    assert np.array_equal(stamps, (np.arange(20) / 24.0).astype(np.float32))
    assert info(tmp_path / "set")["fps"] == 24


def test_a_fractional_rate_is_kept(tmp_path: Path) -> None:
    publish(record(tmp_path / "episodes", frames=20, fps=12.5), tmp_path / "set")
    assert info(tmp_path / "set")["fps"] == 12.5
    assert stranger(tmp_path / "set")["broken"] == []


def test_our_own_line_says_where_poses_come_from(tmp_path: Path) -> None:
    episode = record(tmp_path / "episodes", frames=4, details={"operator": "ann"})
    publish(episode, tmp_path / "set")
    (line,) = lines(tmp_path / "set/meta/eva_episodes.jsonl")
    assert (line["episode_index"], line["uuid"]) == (0, episode.name)
    assert (line["eef_state"], line["eef_action"]) == ("measured", "mixed")
    assert (line["outcome"]["status"], line["outcome"]["operator"]) == ("finished", "ann")
    assert line["configuration_hash"] == "abc"


def test_gr00t_finds_its_groups(tmp_path: Path) -> None:
    publish(record(tmp_path / "episodes", frames=4), tmp_path / "set")
    modality = json.loads((tmp_path / "set/meta/modality.json").read_text())
    groups = {"left_arm": {"start": 0, "end": 3}, "right_arm": {"start": 3, "end": 6}}
    assert (modality["state"], modality["action"]) == (groups, groups)
    assert modality["video"]["cam_high"] == {"original_key": "observation.images.cam_high"}


def test_an_edited_modality_file_is_kept(tmp_path: Path) -> None:
    publish(record(tmp_path / "episodes", frames=4), tmp_path / "set")
    (tmp_path / "set/meta/modality.json").write_text("{}")
    publish(record(tmp_path / "episodes", frames=4), tmp_path / "set")
    assert (tmp_path / "set/meta/modality.json").read_text() == "{}"


def test_tasks_are_numbered_once(tmp_path: Path) -> None:
    for task in ("stack", "sort", "stack"):
        publish(record(tmp_path / "episodes", frames=3, task=task), tmp_path / "set")
    assert [line["task"] for line in lines(tmp_path / "set/meta/tasks.jsonl")] == ["stack", "sort"]
    assert [set(table(tmp_path / "set", k)["task_index"].to_pylist()) for k in range(3)] == [{0}, {1}, {0}]


def test_chunks_are_as_large_as_the_info_says(tmp_path: Path) -> None:
    publish(record(tmp_path / "episodes", frames=3), tmp_path / "set")
    (tmp_path / "set/meta/info.json").write_text(json.dumps(info(tmp_path / "set") | {"chunks_size": 2}))
    for _ in range(2):
        publish(record(tmp_path / "episodes", frames=3), tmp_path / "set")
    assert (tmp_path / "set/data/chunk-001/episode_000002.parquet").is_file()
    assert info(tmp_path / "set")["total_chunks"] == 2
    assert check(tmp_path / "set") == []
    assert stranger(tmp_path / "set")["broken"] == []


def test_the_same_episode_again_is_written_anew_in_its_place(tmp_path: Path) -> None:
    first, second = (record(tmp_path / "episodes", frames=n, seed=n) for n in (6, 8))
    for episode in (first, second):
        publish(episode, tmp_path / "set", success=True)
    other = tmp_path / "set/data/chunk-000/episode_000001.parquet"
    before = other.read_bytes()
    done = publish(first, tmp_path / "set", success=False)
    assert (done.episode_index, done.created) == (0, False)
    assert table(tmp_path / "set")["next.success"].to_pylist() == [False] * 6
    assert other.read_bytes() == before
    assert [line["success"] for line in lines(tmp_path / "set/meta/eva_episodes.jsonl")] == [False, True]
    assert info(tmp_path / "set")["total_episodes"] == 2
    assert check(tmp_path / "set") == []


def test_success_marks_the_last_row(tmp_path: Path) -> None:
    publish(record(tmp_path / "episodes", frames=4, details={"success": True}), tmp_path / "set")
    assert table(tmp_path / "set")["next.success"].to_pylist() == [False, False, False, True]


def test_a_dataset_that_tells_success_takes_no_episode_without(tmp_path: Path) -> None:
    publish(record(tmp_path / "episodes", frames=4), tmp_path / "set", success=True)
    with pytest.raises(RecordingError, match=r"next\.success.*is not known"):
        publish(record(tmp_path / "episodes", frames=4), tmp_path / "set")


def test_a_dataset_that_does_not_tell_success_keeps_it_in_our_own_line(tmp_path: Path) -> None:
    publish(record(tmp_path / "episodes", frames=4), tmp_path / "set")
    publish(record(tmp_path / "episodes", frames=4), tmp_path / "set", success=True)
    assert "next.success" not in table(tmp_path / "set", 1).column_names
    assert [line["success"] for line in lines(tmp_path / "set/meta/eva_episodes.jsonl")] == [None, True]


def test_an_unknown_vector_is_not_a_number_and_not_counted(tmp_path: Path) -> None:
    episode = record(tmp_path / "episodes", frames=5, rows={2: {"effort": None}})
    publish(episode, tmp_path / "set")
    effort = open_dataset(tmp_path / "set").episode(0, WHOLE).effort
    assert effort is not None
    assert np.flatnonzero(np.isnan(effort).any(axis=1)).tolist() == [2]
    statistic = lines(tmp_path / "set/meta/episodes_stats.jsonl")[0]["stats"]["joint_effort"]
    assert statistic["count"] == [4]
    assert check(tmp_path / "set") == []


def test_a_camera_called_image_does_not_spoil_the_statistics(tmp_path: Path) -> None:
    cameras = {"wrist_image": {"width": 64, "height": 48}}
    episode = record(
        tmp_path / "episodes", frames=4, cameras=cameras, capture_streams=["joints", "wrist_image"]
    )
    publish(episode, tmp_path / "set")
    stats = lines(tmp_path / "set/meta/episodes_stats.jsonl")[0]["stats"]
    assert [key for key in stats if "image" in key] == ["observation.images.wrist_image"]
    assert stranger(tmp_path / "set")["broken"] == []


@pytest.mark.parametrize("count", [0, 1, 4])
def test_any_number_of_cameras_will_do(tmp_path: Path, count: int) -> None:
    cameras = {f"camera{n}": {"width": 64, "height": 48} for n in range(count)}
    publish(record(tmp_path / "episodes", frames=4, cameras=cameras, capture_streams=[]), tmp_path / "set")
    assert check(tmp_path / "set") == []
    assert stranger(tmp_path / "set")["broken"] == []


def test_the_pictures_are_copied_and_not_coded_again(tmp_path: Path) -> None:
    import av

    def coded(path: Path) -> list[bytes]:
        with av.open(str(path)) as container:
            return [bytes(packet) for packet in container.demux(video=0) if packet.size]

    episode = record(tmp_path / "episodes", frames=12)
    publish(episode, tmp_path / "set")
    video = tmp_path / "set/videos/chunk-000/observation.images.cam_high/episode_000000.mp4"
    assert coded(video) == coded(open_episode(episode).videos["cam_high"])[:12]


@pytest.mark.parametrize("status", ["interrupted", "failed"])
def test_what_was_not_finished_wants_to_be_asked_for(tmp_path: Path, status: str) -> None:
    episode = record(tmp_path / "episodes", frames=4, status=status)
    with pytest.raises(RecordingError, match=f"{status}: the operator said so.*--include-interrupted"):
        publish(episode, tmp_path / "set")
    assert publish(episode, tmp_path / "set", include_interrupted=True).frames == 4


def test_what_is_still_recorded_is_refused(tmp_path: Path) -> None:
    episode = record(tmp_path / "episodes", frames=4)
    (episode / "outcome.json").unlink()
    with pytest.raises(RecordingError, match=r"no outcome\.json"):
        publish(episode, tmp_path / "set", include_interrupted=True)
    assert not (tmp_path / "set").exists()


def test_an_episode_without_rows_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no rows"):
        publish(record(tmp_path / "episodes", frames=0), tmp_path / "set")


def test_an_action_that_is_not_finite_is_refused_with_its_row(tmp_path: Path) -> None:
    broken = {3: {"action": np.array([0, np.nan, 0, 0, 0, 0], np.float32)}}
    with pytest.raises(RecordingError, match="action of row 3 is not finite"):
        publish(record(tmp_path / "episodes", frames=5, rows=broken), tmp_path / "set")
    assert not (tmp_path / "set/meta/info.json").exists()
    assert publish(record(tmp_path / "episodes", frames=5), tmp_path / "set").episode_index == 0


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_what_was_observed_and_is_not_finite_is_zero_flagged_and_never_dropped(
    tmp_path: Path, version: str
) -> None:
    whole = row(0)
    assert whole.qvel is not None
    broken = {
        2: {"qpos": np.array([0.5, np.nan, 0.5, 0.5, np.inf, 0.5], np.float32)},
        4: {"qvel": np.full_like(whole.qvel, -np.inf), "effort": None},
    }
    done = publish(record(tmp_path / "episodes", frames=6, rows=broken), tmp_path / "set", version=version)
    assert done.frames == 6
    episode = open_dataset(tmp_path / "set").episode(0, WHOLE)
    assert episode.qpos[2].tolist() == [0.5, 0.0, 0.5, 0.5, 0.0, 0.5]
    assert episode.qvel is not None
    assert episode.effort is not None
    assert episode.qvel[4].tolist() == [0.0] * len(whole.qvel)
    assert np.isnan(episode.effort[4]).all(), "not measured is no measurement that is broken"
    (data,) = (tmp_path / "set/data").rglob("*.parquet")
    assert pq.read_table(data)["not_finite"].to_pylist() == [False, False, True, False, True, False]
    assert check(tmp_path / "set") == []


def test_a_dataset_from_before_a_flag_stays_as_it_is_unless_the_flag_is_needed(tmp_path: Path) -> None:
    later = ("skewed", "not_finite", "lost.", "stale.")
    publish(record(tmp_path / "episodes", frames=5), tmp_path / "set")
    known = info(tmp_path / "set")
    assert {
        "skewed",
        "not_finite",
        *(f"{flag}{camera.split('.')[-1]}" for flag in later[2:] for camera in CAMERAS),
    } <= {key.replace("observation.images.", "") for key in known["features"]}
    old = {key: value for key, value in known["features"].items() if not key.startswith(later)}
    (tmp_path / "set/meta/info.json").write_text(json.dumps(known | {"features": old}))
    path = tmp_path / "set/data/chunk-000/episode_000000.parquet"
    pq.write_table(pq.read_table(path).select([key for key in old if old[key]["dtype"] != "video"]), path)
    assert publish(record(tmp_path / "episodes", frames=5), tmp_path / "set").episode_index == 1
    assert table(tmp_path / "set", 1).column_names == table(tmp_path / "set", 0).column_names
    broken = {1: {"qpos": np.full(len(JOINTS), np.nan, np.float32)}}
    with pytest.raises(
        RecordingError, match="not finite in 1 rows, the first is 1, and the dataset has no column"
    ):
        publish(record(tmp_path / "episodes", frames=5, rows=broken), tmp_path / "set")


def test_an_episode_that_lost_a_camera_is_refused_with_its_row_and_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = FragmentedVideo.encode

    def failing(video: FragmentedVideo, picture: Any) -> None:
        if video.frames == 4 and threading.current_thread().name == f"encoder {CAMERAS[1]}":
            raise ValueError("out of order")
        real(video, picture)

    monkeypatch.setattr(FragmentedVideo, "encode", failing)
    episode = record(tmp_path / "episodes", frames=9)
    assert (open_episode(episode).frames, open_episode(episode).frame_count(CAMERAS[1])) == (9, 4)
    with pytest.raises(RecordingError, match=f"the video of {CAMERAS[1]} ends at row 4 of 9: .*out of order"):
        publish(episode, tmp_path / "set")


def test_videos_of_another_encoder_are_said_to_be_what_they_are(tmp_path: Path) -> None:
    journal = EpisodeJournal(tmp_path, RecordingSettings(min_free_bytes=0, codec="libx265"), patient=True)
    journal.begin(told := manifest())
    for index in range(8):
        journal.append(row(index))
    journal.end(Outcome("finished", "", 1.7e9))
    publish(tmp_path / told["uuid"], tmp_path / "set")
    videos = [
        feature for feature in info(tmp_path / "set")["features"].values() if feature["dtype"] == "video"
    ]
    assert [video["info"]["video.codec"] for video in videos] == ["hevc"] * len(CAMERAS)
    with open_dataset(tmp_path / "set").episode(0).pictures(CAMERAS[0]) as pictures:
        assert [seen(pictures[k]) for k in range(8)] == list(range(8))


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"fps": 25.0}, "fps is 30.0 in the dataset, 25.0 here"),
        ({"cameras": {"cam_high": {"width": 64, "height": 48}}}, "has no 'observation.images.cam_wrist'"),
        ({"streams": {"eef": True}}, "the episode has no 'joint_velocity'"),
        (
            {"cameras": {c: {"width": 32, "height": 48} for c in CAMERAS}},
            r"has shape \[48, 64, 3\] in the dataset",
        ),
    ],
)
def test_other_features_are_refused_with_every_difference(
    tmp_path: Path, changes: dict[str, Any], named: str
) -> None:
    publish(record(tmp_path / "episodes", frames=3), tmp_path / "set")
    other = None
    if "cameras" in changes:
        size = next(iter(changes["cameras"].values()))
        pixels = np.zeros((size["height"], size["width"], 3), np.uint8)
        other = {k: {"pictures": dict.fromkeys(changes["cameras"], pixels)} for k in range(3)}
    with pytest.raises(RecordingError, match=named):
        publish(record(tmp_path / "episodes", frames=3, rows=other, **changes), tmp_path / "set")
    assert check(tmp_path / "set") == []


def test_another_robot_is_refused(tmp_path: Path) -> None:
    publish(record(tmp_path / "episodes", frames=3), tmp_path / "set")
    from tests.runtime.datasets.small import manifest

    other = manifest()["robot"] | {"name": "large"}
    with pytest.raises(RecordingError, match="robot_type is 'small' in the dataset, 'large' here"):
        publish(record(tmp_path / "episodes", frames=3, robot=other), tmp_path / "set")


def test_a_folder_with_other_things_in_it_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("precious")
    episode = record(tmp_path / "episodes", frames=3)
    with pytest.raises(RecordingError, match=r"no dataset and not empty.*thesis\.tex"):
        publish(episode, tmp_path)


def test_an_episode_of_another_length_is_refused_in_its_place(tmp_path: Path) -> None:
    name = str(uuid.uuid4())
    publish(record(tmp_path / "a", frames=5, uuid=name), tmp_path / "set")
    with pytest.raises(RecordingError, match=r"has 6 rows, published .* has 5"):
        publish(record(tmp_path / "b", frames=6, uuid=name), tmp_path / "set")


def _publish_until(episode: Path, dataset: Path, steps: int) -> None:
    """Publish in a process that dies, as by a power cut, at rename number `steps`."""
    left = steps

    def die() -> None:
        nonlocal left
        if left == 0:
            os._exit(9)
        left -= 1

    with _before_each_rename(die):
        publish(episode, dataset)


@contextmanager
def _before_each_rename(act: Callable[[], None]) -> Iterator[None]:
    real = os.replace

    def replace(source: Any, target: Any) -> None:
        if Path(target).name != Path(layout.PUBLISHING_PLAN).name:
            act()
        real(source, target)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "replace", replace)
        yield


def _die(episode: Path, dataset: Path, steps: int) -> int:
    context = multiprocessing.get_context("spawn")
    process = context.Process(target=_publish_until, args=(episode, dataset, steps))
    process.start()
    process.join()
    assert process.exitcode is not None
    return process.exitcode


def cuts(episode: Path, dataset: Path, kept: Path, version: str | None = None) -> list[Path]:
    """What a power cut leaves of the dataset at each rename, and after the last: copies in `kept` of what is there."""
    copies: list[Path] = []

    def copy() -> None:
        copies.append(kept / str(len(copies)))
        shutil.copytree(dataset, copies[-1])

    with _before_each_rename(copy):
        publish(episode, dataset, version=version)
    copy()
    return copies


@dataclass(frozen=True)
class Interrupted:
    """A dataset of one episode, another one, and what cuts while that was published have left."""

    old: Path
    episode: Path
    cuts: list[Path]

    def copy(self, steps: int, to: Path) -> Path:
        """The dataset as a cut at rename number `steps` has left it, to be recovered."""
        return shutil.copytree(self.cuts[steps], to)


def _interrupted(version: str, folder: Path, **changes: Any) -> Interrupted:
    dataset, episodes = folder / "set", folder / "episodes"
    publish(record(episodes, frames=6), dataset, version=version)
    old = shutil.copytree(dataset, folder / "old")
    episode = record(episodes, frames=8, seed=8, **changes)
    return Interrupted(old, episode, cuts(episode, dataset, folder / "cuts", version))


@pytest.fixture(scope="module")
def interrupted_v21(tmp_path_factory: pytest.TempPathFactory) -> Interrupted:
    return _interrupted("v2.1", tmp_path_factory.mktemp("interrupted"))


@pytest.fixture(scope="module")
def interrupted_of_another_task(tmp_path_factory: pytest.TempPathFactory) -> Interrupted:
    return _interrupted("v2.1", tmp_path_factory.mktemp("interrupted"), task="another")


@pytest.fixture(scope="module")
def interrupted_v30(tmp_path_factory: pytest.TempPathFactory) -> Interrupted:
    return _interrupted("v3.0", tmp_path_factory.mktemp("interrupted"), task="another")


def contents(dataset: Path) -> dict[str, bytes]:
    return {str(p.relative_to(dataset)): p.read_bytes() for p in dataset.rglob("*") if p.is_file()}


# tasks, two videos, streams, parquet, statistics twice, our lines, episodes, info (the first adds modality.json)
RENAMES = 10


@pytest.mark.some(4)
@pytest.mark.parametrize("steps", range(RENAMES))
def test_a_crash_at_any_rename_leaves_the_old_contents_and_a_second_run_completes(
    tmp_path: Path, interrupted_v21: Interrupted, steps: int
) -> None:
    dataset = interrupted_v21.copy(steps, tmp_path / "set")
    assert stranger(dataset) == stranger(interrupted_v21.old)
    assert [entry.length for entry in open_dataset(dataset).episodes] == [6]
    done = publish(interrupted_v21.episode, dataset)
    assert (done.episode_index, done.created) == (1, True)
    assert check(dataset) == []
    assert stranger(dataset)["broken"] == []


@pytest.mark.parametrize("steps", range(RENAMES))
def test_recovery_takes_back_every_trace(
    tmp_path: Path, interrupted_of_another_task: Interrupted, steps: int
) -> None:
    dataset = interrupted_of_another_task.copy(steps, tmp_path / "set")
    with staging.lock_dataset(dataset):
        staging.recover(dataset)
    assert contents(dataset) == contents(interrupted_of_another_task.old)
    assert check(dataset) == []


@pytest.mark.exhaustive
def test_a_refused_episode_after_a_crash_leaves_a_whole_dataset(tmp_path: Path) -> None:
    dataset = tmp_path / "set"
    publish(record(tmp_path / "episodes", frames=6), dataset)
    assert _die(record(tmp_path / "episodes", frames=8), dataset, RENAMES - 1) == 9
    with pytest.raises(RecordingError, match="fps"):
        publish(record(tmp_path / "episodes", frames=5, fps=20.0), dataset)
    assert check(dataset) == []


def test_a_first_episode_that_was_lost_leaves_no_modalities_to_another_robot(tmp_path: Path) -> None:
    dataset = tmp_path / "set"
    cut = cuts(record(tmp_path / "episodes", frames=4), tmp_path / "lost", tmp_path / "cuts")[5]
    shutil.copytree(cut, dataset)
    cameras = {"top": {"width": 64, "height": 48}}
    publish(record(tmp_path / "episodes", frames=4, cameras=cameras, capture_streams=[]), dataset)
    assert list(json.loads((dataset / "meta/modality.json").read_text())["video"]) == ["top"]


def test_one_more_rename_than_that_is_not_needed(interrupted_v21: Interrupted) -> None:
    *before, after = interrupted_v21.cuts
    assert len(before) == RENAMES
    assert len(open_dataset(after).episodes) == 2


def test_a_crash_at_the_very_first_episode_leaves_no_dataset(tmp_path: Path) -> None:
    episode = record(tmp_path / "episodes", frames=4)
    left = cuts(episode, tmp_path / "set", tmp_path / "cuts")
    assert len(left) == RENAMES + 2  # also that of modality.json, and the whole dataset
    for steps in (0, 5, RENAMES):
        dataset = left[steps]
        assert not (dataset / "meta/info.json").exists()
        assert publish(episode, dataset).episode_index == 0
        assert check(dataset) == []


@pytest.mark.exhaustive
def test_another_episode_after_a_crash_takes_the_index_and_leaves_no_traces(tmp_path: Path) -> None:
    dataset = tmp_path / "set"
    publish(record(tmp_path / "episodes", frames=6), dataset)
    lost = record(tmp_path / "episodes", frames=8, seed=8)
    assert _die(lost, dataset, RENAMES - 1) == 9
    assert check(dataset) != []
    assert publish(record(tmp_path / "episodes", frames=5, seed=5), dataset).episode_index == 1
    assert check(dataset) == []
    assert publish(lost, dataset).episode_index == 2
    assert [entry.length for entry in open_dataset(dataset).episodes] == [6, 5, 8]
    assert stranger(dataset)["broken"] == []


def test_a_crash_while_writing_anew_leaves_a_dataset_that_opens(tmp_path: Path) -> None:
    dataset = tmp_path / "set"
    episodes = [record(tmp_path / "episodes", frames=n, seed=n) for n in (6, 8)]
    for episode in episodes:
        publish(episode, dataset)
    left = cuts(episodes[0], dataset, tmp_path / "cuts")
    for steps in (1, 4, 8):
        assert stranger(left[steps])["broken"] == []
        assert publish(episodes[0], left[steps]).created is False
        assert check(left[steps]) == []


def test_two_publishers_at_once_get_two_indices(tmp_path: Path) -> None:
    dataset = tmp_path / "set"
    context = multiprocessing.get_context("spawn")
    episodes = [record(tmp_path / "episodes", frames=4, seed=n) for n in range(3)]
    processes = [context.Process(target=publish, args=(episode, dataset)) for episode in episodes]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    assert sorted(line["uuid"] for line in lines(dataset / "meta/eva_episodes.jsonl")) == sorted(
        episode.name for episode in episodes
    )
    assert check(dataset) == []


# --- v3.0 --------------------------------------------------------------------------------------------------

# tasks, two videos, streams, parquet, statistics, our lines, episodes, info
RENAMES_V30 = 9


def test_v30_is_written_where_it_is_asked_for_and_kept(tmp_path: Path) -> None:
    episodes = [
        record(tmp_path / "episodes", frames=n, seed=n, task=task) for n, task in ((20, "a"), (7, "b"))
    ]
    publish(episodes[0], tmp_path / "set", version="v3.0", success=True)
    done = publish(episodes[1], tmp_path / "set", success=False)
    assert (done.episode_index, info(tmp_path / "set")["codebase_version"]) == (1, "v3.0")
    assert check(tmp_path / "set") == []
    report = stranger(tmp_path / "set")
    assert report["broken"] == []
    assert report["policy_outputs"] == ["action"]
    assert report["policy_inputs"] == ["observation.state", *(f"observation.images.{c}" for c in CAMERAS)]
    for index, (n, task) in enumerate(((20, "a"), (7, "b"))):
        episode = open_dataset(tmp_path / "set").episode(index, WHOLE)
        rows = [row(k, seed=n) for k in range(n)]
        assert episode.task == task
        assert np.array_equal(episode.qpos, [one.qpos for one in rows])
        assert episode.action is not None
        assert np.array_equal(episode.action, [one.action for one in rows])
        assert report["episodes"][index]["tasks"] == [task]
        for camera in CAMERAS:
            expected = [float(picture(k).mean()) for k in range(n)]
            read = report["episodes"][index]["brightness"][f"observation.images.{camera}"]
            assert read == pytest.approx(expected, abs=2)
    assert report["episodes"][0]["sums"]["next.success"] == 1
    assert sorted(path.name for path in (tmp_path / "set/data/chunk-000").iterdir()) == [
        "file-000.parquet",
        "file-001.parquet",
    ]


def test_a_version_that_a_dataset_does_not_have_is_refused(tmp_path: Path) -> None:
    publish(record(tmp_path / "episodes", frames=3), tmp_path / "set")
    with pytest.raises(RecordingError, match=r"is of version v2\.1, not v3\.0"):
        publish(record(tmp_path / "episodes", frames=3), tmp_path / "set", version="v3.0")
    with pytest.raises(RecordingError, match=r"version is 'v2\.0', published are"):
        publish(record(tmp_path / "episodes", frames=3), tmp_path / "other", version="v2.0")


def test_in_v30_the_same_episode_again_is_written_anew_in_its_place(tmp_path: Path) -> None:
    first, second = (record(tmp_path / "episodes", frames=n, seed=n) for n in (6, 8))
    for episode in (first, second):
        publish(episode, tmp_path / "set", success=True, version="v3.0")
    other = tmp_path / "set/data/chunk-000/file-001.parquet"
    before = other.read_bytes()
    done = publish(first, tmp_path / "set", success=False)
    assert (done.episode_index, done.created) == (0, False)
    assert other.read_bytes() == before
    sums = [episode["sums"]["next.success"] for episode in stranger(tmp_path / "set")["episodes"]]
    assert sums == [0, 1]
    assert check(tmp_path / "set") == []


def test_in_v30_folders_hold_as_many_files_as_the_info_says(tmp_path: Path) -> None:
    publish(record(tmp_path / "episodes", frames=3), tmp_path / "set", version="v3.0")
    (tmp_path / "set/meta/info.json").write_text(json.dumps(info(tmp_path / "set") | {"chunks_size": 2}))
    for _ in range(2):
        publish(record(tmp_path / "episodes", frames=3), tmp_path / "set")
    assert (tmp_path / "set/data/chunk-001/file-000.parquet").is_file()
    assert (tmp_path / "set/videos/observation.images.cam_high/chunk-001/file-000.mp4").is_file()
    assert check(tmp_path / "set") == []
    assert stranger(tmp_path / "set")["broken"] == []


@pytest.mark.some(1)
@pytest.mark.parametrize("steps", [2, 5, 7, RENAMES_V30 - 1])
def test_in_v30_a_crash_between_renames_is_taken_back_without_a_trace(
    tmp_path: Path, interrupted_v30: Interrupted, steps: int
) -> None:
    dataset = interrupted_v30.copy(steps, tmp_path / "set")
    assert [entry.length for entry in open_dataset(dataset).episodes] == [6]
    with staging.lock_dataset(dataset):
        staging.recover(dataset)
    assert contents(dataset) == contents(interrupted_v30.old)
    done = publish(interrupted_v30.episode, dataset)
    assert (done.episode_index, done.created) == (1, True)
    assert check(dataset) == []
    assert stranger(dataset)["broken"] == []


def test_in_v30_one_more_rename_than_that_is_not_needed(interrupted_v30: Interrupted) -> None:
    *before, after = interrupted_v30.cuts
    assert len(before) == RENAMES_V30
    assert len(open_dataset(after).episodes) == 2


def test_in_v30_a_crash_at_the_very_first_episode_leaves_no_dataset(tmp_path: Path) -> None:
    episode = record(tmp_path / "episodes", frames=4)
    left = cuts(episode, tmp_path / "set", tmp_path / "cuts", "v3.0")
    for steps in (5, RENAMES_V30):
        dataset = left[steps]
        assert not (dataset / "meta/info.json").exists()
        assert publish(episode, dataset, version="v2.1").episode_index == 0
        assert check(dataset) == []


# --- a simulated robot -------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["rollout", "demonstration"])
def test_a_run_of_mode_sim_is_never_published(tmp_path: Path, kind: str) -> None:
    folder = record(tmp_path / "episodes", frames=4, mode="sim", kind=kind)
    with pytest.raises(
        RecordingError, match=r"is a run of mode sim: .* it is no rollout and no demonstration"
    ):
        publish(folder, tmp_path / "set", success=True, include_interrupted=True)
    assert not (tmp_path / "set").exists()


def test_rows_of_a_simulated_robot_are_refused_whatever_the_manifest_says(tmp_path: Path) -> None:
    folder = record(tmp_path / "episodes", frames=4, rows={2: {"control_source": "sim"}})
    with pytest.raises(RecordingError, match="1 of its rows are actions of a simulated robot"):
        publish(folder, tmp_path / "set")


@pytest.mark.exhaustive
def test_an_episode_from_before_strategies_were_written_down_is_published(tmp_path: Path) -> None:
    folder = record(tmp_path / "episodes", frames=4)
    old_raw(folder / "raw.arrow")
    unsealed(folder)
    assert publish(folder, tmp_path / "set").frames == 4
