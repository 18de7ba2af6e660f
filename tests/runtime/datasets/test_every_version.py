from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from runtime.core.errors import RecordingError
from runtime.datasets.consistency import check
from runtime.datasets.mapping import ColumnMapping
from runtime.datasets.reader import open_dataset
from tests.runtime.datasets.foreign import Plan, column, shown, write
from tests.runtime.datasets.small import seen

MAPPING = ColumnMapping(eef="observation.eef", action_eef="action_eef")
PLANS = {
    "v2.0": Plan("v2.0"),
    "v2.1": Plan("v2.1"),
    "v3.0": Plan(),
    "v3.0, one row group": Plan(groups=False, per_data=3),
    "v3.0, files of their own": Plan(per_data=1, per_video=1),
    "v3.0, small chunks": Plan(lengths=(3, 4, 5, 6, 3), per_data=1, per_video=2, per_chunk=2),
    "v3.0, short groups": Plan(gop=3, b_frames=2),
    "v3.0, no key frames between": Plan(key_frames=False),
    "v3.0, fractional rate": Plan(fps=12.5),
    "v3.0, rate without end": Plan(fps=30000 / 1001),
    "v2.1, images": Plan("v2.1", videos=("cam_high",), images=("cam_wrist",)),
    "v3.0, images": Plan(videos=("cam_high",), images=("cam_wrist",)),
    "v3.0, no cameras": Plan(videos=()),
}


@pytest.fixture(params=PLANS.values(), ids=list(PLANS))
def plan(request: pytest.FixtureRequest) -> Plan:
    made: Plan = request.param
    return made


@pytest.mark.some(4)
def test_every_episode_has_its_rows_pictures_and_task(tmp_path: Path, plan: Plan) -> None:
    write(tmp_path / "set", plan)
    dataset = open_dataset(tmp_path / "set")
    assert (dataset.version, dataset.fps) == (plan.version, plan.fps)
    assert [entry.length for entry in dataset.episodes] == list(plan.lengths)
    for index, length in enumerate(plan.lengths):
        episode = dataset.episode(index, MAPPING)
        for values, name in (
            (episode.qpos, "observation.state"),
            (episode.eef, "observation.eef"),
            (episode.action, "action"),
            (episode.action_eef, "action_eef"),
        ):
            assert values is not None
            assert np.array_equal(values, column(index, name, length))
        assert episode.task == f"task {index % 2}"
        assert set(episode.cameras) == {*plan.videos, *plan.images}
        assert np.allclose(episode.timestamps, np.arange(length) / plan.fps)
        for camera in episode.cameras:
            with episode.pictures(camera) as pictures:
                assert len(pictures) == length
                wanted = [shown(index, k) for k in range(length)]
                assert [seen(pictures[k]) for k in range(length)] == wanted
                assert [seen(pictures[k]) for k in reversed(range(length))] == wanted[::-1]
                with pytest.raises(IndexError, match=f"0 to {length - 1}"):
                    pictures[length]


@pytest.mark.some(6)
def test_what_others_write_is_whole(tmp_path: Path, plan: Plan) -> None:
    write(tmp_path / "set", plan)
    assert check(tmp_path / "set") == []


def episodes_file(root: Path) -> Path:
    return root / "meta/episodes/chunk-000/file-000.parquet"


def edit(root: Path, name: str, values: list[float]) -> None:
    table = pq.read_table(episodes_file(root))
    made = pa.array(values, table.schema.field(name).type)
    pq.write_table(table.set_column(table.column_names.index(name), name, made), episodes_file(root))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write(tmp_path / "set", Plan())
    return tmp_path / "set"


def test_a_missing_list_of_episodes_is_named(root: Path) -> None:
    for path in (root / "meta/episodes").rglob("*.parquet"):
        path.unlink()
    with pytest.raises(RecordingError, match=r"meta/episodes has no chunk-000/file-000\.parquet"):
        open_dataset(root)


def test_a_list_of_episodes_without_a_place_is_named(root: Path) -> None:
    table = pq.read_table(episodes_file(root))
    pq.write_table(table.drop_columns(["data/file_index"]), episodes_file(root))
    with pytest.raises(RecordingError, match=r"meta/episodes: .*is no episode.*data/file_index"):
        open_dataset(root)


def test_a_torn_list_of_episodes_is_named(root: Path) -> None:
    episodes_file(root).write_bytes(episodes_file(root).read_bytes()[:-20])
    with pytest.raises(RecordingError, match=r"file-000\.parquet cannot be read"):
        open_dataset(root)


def test_tasks_without_a_name_are_named(root: Path) -> None:
    pq.write_table(pa.table({"task_index": [0, 1]}), root / "meta/tasks.parquet")
    with pytest.raises(RecordingError, match=r"tasks\.parquet has columns \['task_index'\]"):
        open_dataset(root)


def test_tasks_of_a_column_called_task_are_read(root: Path) -> None:
    pq.write_table(pa.table({"task": ["a", "b"], "task_index": [0, 1]}), root / "meta/tasks.parquet")
    assert open_dataset(root).tasks == {0: "a", 1: "b"}


def test_a_missing_data_file_is_named_by_the_episodes_in_it_alone(root: Path) -> None:
    (root / "data/chunk-000/file-000.parquet").unlink()
    dataset = open_dataset(root)
    with pytest.raises(RecordingError, match=r"there is no .*data/chunk-000/file-000\.parquet"):
        dataset.episode(1)
    assert dataset.episode(2).length == 9


def test_rows_without_their_episode_are_refused(root: Path) -> None:
    path = root / "data/chunk-000/file-000.parquet"
    pq.write_table(pq.read_table(path).drop_columns(["episode_index"]), path)
    with pytest.raises(RecordingError, match="holds several episodes but has no column episode_index"):
        open_dataset(root).episode(0)


def test_fewer_rows_than_listed_are_refused(root: Path) -> None:
    path = root / "data/chunk-000/file-000.parquet"
    pq.write_table(pq.read_table(path).slice(0, 10), path)
    with pytest.raises(RecordingError, match=r"has 3 rows of episode 1, .* says 5"):
        open_dataset(root).episode(1)


def test_a_stretch_beyond_the_video_is_refused(root: Path) -> None:
    edit(root, "videos/observation.images.cam_high/from_timestamp", [0.0, 1.8])
    with pytest.raises(RecordingError, match=r"1\.800 to 2\.300 s has 3 frames for 5 rows"):
        open_dataset(root).episode(1).pictures("cam_high")


def test_a_stretch_between_two_frames_is_refused_by_the_check(root: Path) -> None:
    edit(root, "videos/observation.images.cam_high/from_timestamp", [0.0, 0.73])
    assert any("is 0.030000 s off k / fps" in problem for problem in check(root))


def test_a_missing_video_is_named(root: Path) -> None:
    path = root / "videos/observation.images.cam_high/chunk-000/file-000.mp4"
    path.unlink()
    with pytest.raises(RecordingError, match=f"there is no video {path}"):
        open_dataset(root).episode(0).pictures("cam_high")


@pytest.mark.parametrize(
    ("stored", "named"),
    [
        ({"bytes": b"no picture", "path": None}, "picture 1 cannot be decoded"),
        ({"bytes": None, "path": None}, "picture 1 is missing"),
        ({"bytes": None, "path": "images/absent.png"}, "cannot be decoded.*absent"),
        ({"bytes": None, "path": "../secret.png"}, "lies outside of the dataset"),
        (None, "picture 1 is missing"),
    ],
)
def test_a_broken_picture_is_named(tmp_path: Path, stored: object, named: str) -> None:
    write(tmp_path / "set", Plan("v2.1", lengths=(3,), videos=(), images=("cam",)))
    path = tmp_path / "set/data/chunk-000/episode_000000.parquet"
    table, key = pq.read_table(path), "observation.images.cam"
    rows = table[key].to_pylist()
    rows[1] = stored
    made = pa.array(rows, table.schema.field(key).type)
    pq.write_table(table.set_column(table.column_names.index(key), key, made), path)
    with open_dataset(tmp_path / "set").episode(0).pictures("cam") as pictures:
        assert seen(pictures[0]) == 0
        with pytest.raises(RecordingError, match=named):
            pictures[1]


def test_pictures_in_files_of_their_own_are_read(tmp_path: Path) -> None:
    write(tmp_path / "set", Plan("v2.1", lengths=(3,), videos=(), images=("cam",)))
    path = tmp_path / "set/data/chunk-000/episode_000000.parquet"
    table, key = pq.read_table(path), "observation.images.cam"
    (tmp_path / "set/images").mkdir()
    rows = []
    for number, row in enumerate(table[key].to_pylist()):
        (tmp_path / f"set/images/{number}.png").write_bytes(row["bytes"])
        rows.append({"bytes": None, "path": f"images/{number}.png"})
    made = pa.array(rows, table.schema.field(key).type)
    pq.write_table(table.set_column(table.column_names.index(key), key, made), path)
    with open_dataset(tmp_path / "set").episode(0).pictures("cam") as pictures:
        assert [seen(pictures[k]) for k in range(3)] == [0, 1, 2]


def test_a_check_of_v30_finds_rows_that_do_not_follow_each_other(root: Path) -> None:
    edit(root, "dataset_from_index", [0, 6])
    assert any("episode 1 is rows (6, 12), expected (7, 12)" in problem for problem in check(root))


def test_a_check_of_v30_finds_stretches_of_another_length(root: Path) -> None:
    edit(root, "videos/observation.images.cam_high/to_timestamp", [0.7, 1.3])
    assert any("is 0.7 to 1.3 s for 5 rows" in problem for problem in check(root))


def test_totals_of_v30_are_checked(root: Path) -> None:
    path = root / "meta/info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"total_frames": 3}))
    assert "info.json says total_frames 3, the lists give 21" in check(root)
