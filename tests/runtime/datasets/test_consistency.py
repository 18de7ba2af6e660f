from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from runtime.datasets.consistency import check
from runtime.datasets.published import publish
from tests.runtime.datasets.small import record, write_video


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    for n in (6, 5):
        publish(record(tmp_path / "episodes", frames=n, seed=n), tmp_path / "set")
    return tmp_path / "set"


def edit_info(dataset: Path, **changes: Any) -> None:
    path = dataset / "meta/info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def edit_column(dataset: Path, name: str, edit: Callable[[Any], Any]) -> None:
    path = dataset / "data/chunk-000/episode_000001.parquet"
    table = pq.read_table(path)
    place = table.column_names.index(name)
    pq.write_table(table.set_column(place, name, edit(table[name])), path)


def drop_last_line(path: Path) -> None:
    path.write_text("".join(line + "\n" for line in path.read_text().splitlines()[:-1]))


def spoil_mean(dataset: Path) -> None:
    path = dataset / "meta/episodes_stats.jsonl"
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    lines[0]["stats"]["action"]["mean"][2] += 0.5
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))


VIDEO = "videos/chunk-000/observation.images.cam_high/episode_000001.mp4"
SPOILED: list[tuple[Callable[[Path], object], str]] = [
    (lambda d: edit_info(d, total_frames=12), "total_frames 12, the lists give 11"),
    (lambda d: edit_info(d, splits={"train": "0:1"}), "splits"),
    (lambda d: edit_info(d, codebase_version="v1.6"), "v1.6"),
    (lambda d: edit_info(d, codebase_version="v3.0"), "meta/episodes has no chunk-000/file-000.parquet"),
    (lambda d: (d / "meta/info.json").unlink(), "info.json does not exist"),
    (lambda d: (d / VIDEO).unlink(), "episode 1: there is no video .*cam_high"),
    (lambda d: (d / VIDEO).write_bytes(b"nothing"), "episode 1: .*cannot be opened as a video"),
    (lambda d: write_video(d / VIDEO, 4, 30.0), "'observation.images.cam_high' has 4 frames for 5 rows"),
    (lambda d: write_video(d / VIDEO, 5, 10.0), "is 0.2[0-9]* s off k / fps"),
    (lambda d: edit_column(d, "index", lambda c: pc.subtract(c, 1)), "episode 1: 'index' is not"),
    (
        lambda d: edit_column(d, "timestamp", lambda c: c.cast(pa.float64())),
        "'timestamp' is stored as double",
    ),
    (lambda d: edit_column(d, "task_index", lambda c: pc.add(c, 7)), r"task_index \[7\] is not in"),
    (
        lambda d: drop_last_line(d / "meta/episodes_stats.jsonl"),
        "episode 1: no statistics in meta/episodes_stats",
    ),
    (lambda d: drop_last_line(d / "meta/episodes.jsonl"), "total_episodes 2, the lists give 1"),
    (spoil_mean, "episode 0: mean of 'action'"),
    (lambda d: pq.write_table(pa.table({}), d / "data/chunk-000/episode_000002.parquet"), "to no episode"),
]


def test_a_published_dataset_is_whole(dataset: Path) -> None:
    assert check(dataset) == []


@pytest.mark.parametrize(("spoil", "named"), SPOILED, ids=[named for _, named in SPOILED])
def test_whatever_is_spoiled_is_found(dataset: Path, spoil: Callable[[Path], object], named: str) -> None:
    spoil(dataset)
    problems = check(dataset)
    assert any(re.search(named, problem) for problem in problems), problems


def test_the_sample_episode_is_whole() -> None:
    sample = os.environ.get("EVA_SAMPLE_EPISODE")
    if not sample:
        pytest.skip("EVA_SAMPLE_EPISODE does not name a LeRobot v2.1 dataset to try")
    assert check(Path(sample)) == []
