"""The real episode through the whole pipeline: what is recorded and what is published equal the source."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow.parquet as pq
import pytest

from runtime.datasets.consistency import check
from runtime.recording.reader import Episode, open_episode

REPOSITORY = Path(__file__).parents[4]
FRAMES, FPS = 398, 30
CAMERAS = ("cam_high", "cam_left_wrist", "cam_right_wrist")
GRIPPERS = (6, 13)
# journal column, published column, source column
VECTORS = (
    ("qpos", "observation.state", "observation.qpos"),
    ("action", "action", "action"),
    ("eef", "eef_state", "observation.eef"),
    ("eef_action", "eef_action", "action_eef"),
    ("qvel", "joint_velocity", "observation.qvel"),
    ("effort", "joint_effort", "observation.effort"),
)

pytestmark = [
    pytest.mark.exhaustive,
    pytest.mark.skipif(
        not os.environ.get("EVA_SAMPLE_EPISODE"), reason="EVA_SAMPLE_EPISODE does not name the real episode"
    ),
]


def vectors(table: Any, name: str) -> np.ndarray:
    column = table[name].combine_chunks()
    return np.asarray(column.flatten()).reshape(len(column), -1)


def pictures(path: Path) -> Iterator[np.ndarray]:
    with av.open(str(path)) as container:
        for frame in container.decode(video=0):
            yield frame.to_ndarray(format="rgb24")


def packets(path: Path) -> list[bytes]:
    """The pictures as they are coded."""
    with av.open(str(path)) as container:
        return [bytes(packet) for packet in container.demux(video=0) if packet.size]


def psnr(one: np.ndarray, other: np.ndarray) -> float:
    """Peak signal-to-noise ratio of two 8-bit pictures [dB]."""
    error = one.astype(np.int16) - other
    return float(20 * np.log10(255) - 10 * np.log10(max(np.mean(np.square(error, dtype=np.int32)), 1e-12)))


@dataclass(frozen=True)
class RoundTrip:
    """The source, what was recorded of it, what was published, and what the program printed."""

    source: Path
    data: Path
    printed: str

    @cached_property
    def rows(self) -> Any:
        return pq.read_table(self.source / "data/chunk-000/episode_000000.parquet")

    @cached_property
    def journal(self) -> Episode:
        (folder,) = (self.data / "episodes").iterdir()
        return open_episode(folder)

    @property
    def dataset(self) -> Path:
        return self.data / "datasets/replayed"

    @cached_property
    def published(self) -> Any:
        return pq.read_table(self.dataset / "data/chunk-000/episode_000000.parquet")

    def source_video(self, camera: str) -> Path:
        return self.source / f"videos/chunk-000/observation.images.{camera}/episode_000000.mp4"

    def published_video(self, camera: str) -> Path:
        return self.dataset / f"videos/chunk-000/observation.images.{camera}/episode_000000.mp4"


@pytest.fixture(scope="module")
def trip(tmp_path_factory: pytest.TempPathFactory) -> RoundTrip:
    source, data = Path(os.environ["EVA_SAMPLE_EPISODE"]).absolute(), tmp_path_factory.mktemp("data")
    done = subprocess.run(
        [
            *(sys.executable, "-m", "runtime", "deployments/replay_dataset.toml", "--lockstep"),
            *("--set", f"transport.path={source}", "--set", f"policy.path={source}"),
            *("--set", f"data_dir={data}", "--set", "recording.min_free_bytes=0"),
        ],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return RoundTrip(source, data, done.stdout)


def test_it_ends_with_the_episode_and_says_where_everything_lies(trip: RoundTrip) -> None:
    state, episode, export, dataset = trip.printed.splitlines()
    assert state == "ready: the recording that is the source has ended"
    assert episode == f"episode  {trip.journal.path}  {FRAMES} rows, finished"
    assert export.startswith("export   ")
    assert export.endswith(f"{trip.journal.path.name}.parquet")
    assert dataset == f"dataset  {trip.dataset}  episode 0, {FRAMES} frames"


def test_as_many_rows_are_recorded_and_published_as_the_source_has(trip: RoundTrip) -> None:
    assert trip.rows.num_rows == trip.journal.frames == trip.published.num_rows == FRAMES
    assert trip.journal.rows.num_rows == trip.journal.ticks.num_rows == FRAMES
    assert trip.journal.outcome is not None
    assert trip.journal.outcome["held_rows"] == 0
    assert set(trip.journal.rows["control_source"].to_pylist()) == {"policy"}


@pytest.mark.parametrize(("recorded", "published", "source"), VECTORS)
def test_every_vector_equals_the_source_to_the_last_bit(
    trip: RoundTrip, recorded: str, published: str, source: str
) -> None:
    wanted = vectors(trip.rows, source)
    assert wanted.dtype == np.float32
    for table, name in ((trip.journal.rows, recorded), (trip.published, published)):
        found = vectors(table, name)
        assert found.dtype == np.float32
        assert found.tobytes() == wanted.tobytes(), name


def test_poses_are_those_that_the_robot_told_in_every_row(trip: RoundTrip) -> None:
    for flag in ("eef_measured", "eef_action_reported"):
        assert all(trip.journal.rows[flag].to_pylist())


def test_times_are_exactly_k_over_30(trip: RoundTrip) -> None:
    wanted = (np.arange(FRAMES) / FPS).astype(np.float32)
    published = trip.published["timestamp"].to_numpy()
    assert published.dtype == np.float32
    assert published.tobytes() == wanted.tobytes()
    assert published.tobytes() == trip.rows["timestamp"].to_numpy().tobytes()
    assert np.array_equal(trip.journal.rows["time"].to_numpy(), np.arange(FRAMES) / FPS)
    late = trip.journal.rows["tick_time"].to_numpy() - np.arange(FRAMES) / FPS
    assert np.ptp(late) < 1e-9


@pytest.mark.parametrize(
    "camera",
    CAMERAS,
)
def test_every_picture_of_every_camera_is_within_coding_loss(trip: RoundTrip, camera: str) -> None:
    pairs = zip(pictures(trip.source_video(camera)), pictures(trip.published_video(camera)), strict=True)
    quality = [psnr(one, other) for one, other in pairs]
    assert len(quality) == FRAMES
    assert min(quality) > 38, f"frame {int(np.argmin(quality))}"


@pytest.mark.parametrize("camera", CAMERAS)
def test_the_published_pictures_are_the_recorded_ones_not_coded_again(trip: RoundTrip, camera: str) -> None:
    recorded = packets(trip.journal.videos[camera])
    assert len(recorded) == FRAMES
    assert recorded == packets(trip.published_video(camera))
    assert not any(trip.journal.rows[f"repeated.{camera}"].to_pylist())


def test_what_was_asked_for_is_what_was_sent_and_each_step_names_its_chunk(trip: RoundTrip) -> None:
    asked, sent = vectors(trip.journal.smoothed, "smoothed"), vectors(trip.journal.ticks, "executed")
    assert asked.tobytes() == sent.tobytes()
    assert all(
        weights and abs(sum(weights) - 1) < 1e-9 for weights in trip.journal.smoothed["weights"].to_pylist()
    )
    raw = trip.journal.raw.to_pylist()
    assert {row["delay"] for row in raw} == {0}
    source = vectors(trip.rows, "action")
    first = trip.journal.rows["step"][0].as_py()
    for row in raw:
        assert row["target_step"] == row["observation_step"] + row["index"]
        assert np.array_equal(np.float32(row["action"]), source[min(row["target_step"] - first, FRAMES - 1)])


def test_report_only_safety_lists_exactly_the_grippers_beyond_their_range(trip: RoundTrip) -> None:
    actions = vectors(trip.rows, "action").astype(np.float64)
    beyond = (actions < -1e-6) | (actions > 0.1 + 1e-6)
    wanted = [[dim for dim in GRIPPERS if beyond[k, dim]] for k in range(FRAMES)]
    assert any(wanted)
    names = {6: "left_arm.joint6", 13: "right_arm.joint6"}
    for k, changes in enumerate(trip.journal.ticks["changes"].to_pylist()):
        listed = [re.fullmatch(r"(\S+) (\S+) is outside 0\.\.0\.1", note) for note in changes]
        found = {match[1]: float(match[2]) for match in listed if match}
        assert found == {names[dim]: pytest.approx(actions[k, dim], abs=5e-5) for dim in wanted[k]}
    assert not any(trip.journal.ticks["refused"].to_pylist())


def test_the_dataset_keeps_every_promise_of_the_format(trip: RoundTrip) -> None:
    assert check(trip.dataset) == []
    done = subprocess.run(
        [sys.executable, "-I", str(REPOSITORY / "tests/conformance/read_lerobot_v21.py"), str(trip.dataset)],
        capture_output=True,
        text=True,
        check=True,
    )
    told = json.loads(done.stdout)
    assert told["broken"] == []
