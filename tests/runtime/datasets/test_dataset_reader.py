from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

from runtime.core.errors import RecordingError
from runtime.datasets.mapping import ColumnMapping
from runtime.datasets.reader import open_dataset
from tests.runtime.datasets.small import seen, write_dataset


def test_it_reads_every_mapped_column_exactly(tmp_path: Path) -> None:
    written = write_dataset(tmp_path, lengths=(7, 9), names={"observation.state": "obs.qpos"})
    mapping = ColumnMapping(state="obs.qpos", eef="observation.eef", action_eef="action_eef")
    episode = open_dataset(tmp_path).episode(1, mapping)
    assert episode.length == 9
    for values, name in (
        (episode.qpos, "obs.qpos"),
        (episode.action, "action"),
        (episode.eef, "observation.eef"),
        (episode.action_eef, "action_eef"),
    ):
        assert values is not None
        assert values.dtype == np.float32
        assert np.array_equal(values, written[1][name])
    assert episode.qvel is None
    assert episode.effort is None
    assert episode.task == "task 1"
    assert episode.timestamps.dtype == np.float64
    assert np.allclose(episode.timestamps, np.arange(9) / 10)


def test_rows_cannot_be_written_to(tmp_path: Path) -> None:
    write_dataset(tmp_path)
    episode = open_dataset(tmp_path).episode(0)
    with pytest.raises(ValueError, match="read-only"):
        episode.qpos[0, 0] = 1.0


def test_it_takes_templates_and_chunks_from_the_info(tmp_path: Path) -> None:
    write_dataset(tmp_path, lengths=(3, 4, 5), chunks_size=2, cameras=("cam_high",))
    dataset = open_dataset(tmp_path)
    assert [entry.length for entry in dataset.episodes] == [3, 4, 5]
    assert dataset.episode(2).videos["cam_high"].path.parts[-3] == "part-001"
    with dataset.episode(2).pictures("cam_high") as pictures:
        assert seen(pictures[4]) == 4


def test_a_fractional_rate_stays_a_float(tmp_path: Path) -> None:
    write_dataset(tmp_path, fps=12.5, cameras=())
    assert open_dataset(tmp_path).fps == 12.5


def test_capture_times_are_read_where_they_are_mapped(tmp_path: Path) -> None:
    write_dataset(tmp_path)
    episode = open_dataset(tmp_path).episode(0, ColumnMapping(capture_time={"joints": "timestamp"}))
    assert np.array_equal(episode.captured["joints"], episode.timestamps)


def test_a_camera_may_have_any_video_key(tmp_path: Path) -> None:
    write_dataset(tmp_path)
    mapping = ColumnMapping(videos={"front": "observation.images.cam_high"})
    assert list(open_dataset(tmp_path).episode(0, mapping).videos) == ["front"]


def test_an_empty_name_says_that_there_is_no_such_column(tmp_path: Path) -> None:
    write_dataset(tmp_path)
    assert open_dataset(tmp_path).episode(0, ColumnMapping(action="")).action is None


@pytest.mark.parametrize(
    ("mapping", "named"),
    [
        (ColumnMapping(state="observation.qpos"), "observation.state"),
        (ColumnMapping(videos={"front": "front"}), "observation.images.cam_high"),
        (ColumnMapping(capture_time={"joints": "action"}), "vectors"),
    ],
)
def test_what_is_absent_is_named_with_what_there_is(
    tmp_path: Path, mapping: ColumnMapping, named: str
) -> None:
    write_dataset(tmp_path)
    with pytest.raises(RecordingError, match=named):
        open_dataset(tmp_path).episode(0, mapping)


def test_an_absent_episode_is_named_with_those_there_are(tmp_path: Path) -> None:
    write_dataset(tmp_path, lengths=(3, 3))
    with pytest.raises(RecordingError, match="no episode 7, there are 2: 0 to 1"):
        open_dataset(tmp_path).episode(7)


def test_an_absent_camera_is_named_with_those_there_are(tmp_path: Path) -> None:
    write_dataset(tmp_path)
    with pytest.raises(RecordingError, match=r"'top'.*cam_high"):
        open_dataset(tmp_path).episode(0).pictures("top")


def test_a_short_video_is_refused(tmp_path: Path) -> None:
    write_dataset(tmp_path, lengths=(5, 9))
    short = next(tmp_path.glob("films/*/*cam_high/take_000000.mp4"))
    long = next(tmp_path.glob("films/*/*cam_high/take_000001.mp4"))
    long.write_bytes(short.read_bytes())
    with pytest.raises(RecordingError, match="5 frames for 9 rows"):
        open_dataset(tmp_path).episode(1).pictures("cam_high")


def test_rows_and_length_must_agree(tmp_path: Path) -> None:
    write_dataset(tmp_path, lengths=(5,))
    (tmp_path / "meta/episodes.jsonl").write_text('{"episode_index": 0, "tasks": [], "length": 6}\n')
    with pytest.raises(RecordingError, match=r"has 5 rows of episode 0, .*meta says 6"):
        open_dataset(tmp_path).episode(0)


def test_episodes_that_the_info_does_not_count_are_not_there(tmp_path: Path) -> None:
    write_dataset(tmp_path, lengths=(3, 4))
    info = json.loads((tmp_path / "meta/info.json").read_text()) | {"total_episodes": 1}
    (tmp_path / "meta/info.json").write_text(json.dumps(info))
    with pytest.raises(
        RecordingError, match=r"lists 2 episodes \(0, 1\), meta/info.json counts 1: correct the one"
    ):
        open_dataset(tmp_path)
    (tmp_path / ".publishing").mkdir()  # ours, cut off
    (tmp_path / ".publishing/plan.json").write_text('{"episode_index": 1, "files": []}')
    assert [entry.index for entry in open_dataset(tmp_path).episodes] == [0]


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"codebase_version": "v1.6"}, r"'v1.6', readable are \('v2.0', 'v2.1', 'v3.0'\)"),
        ({"fps": 0}, "positive"),
        ({"data_path": "data/{nonsense}.parquet"}, "nonsense"),
        ({"data_path": "../{episode_index}.parquet"}, "leads out of the dataset"),
    ],
)
def test_an_info_that_cannot_be_followed_is_refused(
    tmp_path: Path, change: dict[str, object], named: str
) -> None:
    write_dataset(tmp_path)
    info = json.loads((tmp_path / "meta/info.json").read_text()) | change
    (tmp_path / "meta/info.json").write_text(json.dumps(info))
    with pytest.raises(RecordingError, match=named):
        open_dataset(tmp_path).episode(0)


def test_a_torn_line_is_named(tmp_path: Path) -> None:
    write_dataset(tmp_path)
    with open(tmp_path / "meta/episodes.jsonl", "a") as file:
        file.write('{"episode_index": 1, "len')
    with pytest.raises(RecordingError, match="line 2"):
        open_dataset(tmp_path)


def test_a_folder_that_is_no_dataset_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"info\.json"):
        open_dataset(tmp_path)
    with pytest.raises(RecordingError, match="no dataset folder"):
        open_dataset(tmp_path / "absent")


def test_it_reads_the_sample_episode() -> None:
    sample = os.environ.get("EVA_SAMPLE_EPISODE")
    if not sample:
        pytest.skip("EVA_SAMPLE_EPISODE does not name a LeRobot v2.1 dataset to try")
    mapping = ColumnMapping(
        state="observation.qpos",
        eef="observation.eef",
        velocity="observation.qvel",
        effort="observation.effort",
        action_eef="action_eef",
    )
    episode = open_dataset(sample).episode(0, mapping)
    assert (episode.length, episode.fps, episode.qpos.shape[1]) == (398, 30.0, 14)
    assert sorted(episode.videos) == ["cam_high", "cam_left_wrist", "cam_right_wrist"]
    with episode.pictures("cam_high") as forward, episode.pictures("cam_high") as anywhere:
        inorder = {k: forward[k] for k in range(260)}
        for k in (259, 3, 225, 226, 227, 4, 100):
            assert np.array_equal(anywhere[k], inorder[k])
