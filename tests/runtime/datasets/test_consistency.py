from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from contextlib import suppress
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.core.errors import RecordingError
from runtime.datasets.__main__ import main
from runtime.datasets.consistency import check, check_with_remarks, is_rounding_error
from runtime.datasets.publishing import publish
from runtime.datasets.rows import read_rows, write_table
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


@pytest.mark.some(6)
@pytest.mark.parametrize(("spoil", "named"), SPOILED, ids=[named for _, named in SPOILED])
def test_whatever_is_spoiled_is_found(dataset: Path, spoil: Callable[[Path], object], named: str) -> None:
    spoil(dataset)
    problems = check(dataset)
    assert any(re.search(named, problem) for problem in problems), problems


@given(at=st.floats(0, 1), bit=st.integers(0, 7))
def test_no_damaged_number_is_read_from_rows_that_we_wrote(
    tmp_path_factory: pytest.TempPathFactory, at: float, bit: int
) -> None:
    path = tmp_path_factory.mktemp("rows") / "rows.parquet"
    noise = np.random.default_rng(0).normal(size=(50, 7)).astype(np.float32)
    table = pa.table({"state": list(noise), "index": np.arange(50), "who": ["policy", "hold"] * 25})
    write_table(table, path)
    content = bytearray(path.read_bytes())
    footer = len(content) - 8 - int.from_bytes(content[-8:-4], "little")
    content[4 + int(at * (footer - 5))] ^= 1 << bit
    path.write_bytes(content)
    with suppress(RecordingError):
        found = read_rows(path, None)
        assert found.equals(table.cast(found.schema))


def test_the_sample_episode_is_whole() -> None:
    sample = os.environ.get("EVA_SAMPLE_EPISODE")
    if not sample:
        pytest.skip("EVA_SAMPLE_EPISODE does not name a LeRobot v2.1 dataset to try")
    assert check(Path(sample)) == []


def single(values: Any) -> tuple[Any, Any]:
    """Mean and deviation as LeRobot's running statistics have them: sums of float32, row by row."""
    rows = np.asarray(values, np.float32)
    total, squares = (reduce(np.add, each) for each in (rows, rows**2))
    mean, square = total / np.float32(len(rows)), squares / np.float32(len(rows))
    return mean, np.sqrt(np.maximum(square - mean**2, 0))


def restate(dataset: Path, edit: Callable[[dict[str, Any]], object]) -> None:
    path = dataset / "meta/episodes_stats.jsonl"
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    edit(lines[0]["stats"])
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))


def test_a_deviation_of_constant_joints_off_by_rounding_is_a_remark(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dataset = publish(record(tmp_path / "episodes", frames=20), tmp_path / "set").dataset

    def still(column: Any) -> Any:
        return pa.array([[2.1] * column.type.list_size] * len(column), column.type)

    path = dataset / "data/chunk-000/episode_000000.parquet"
    table = pq.read_table(path)
    place = table.column_names.index("action")
    pq.write_table(table.set_column(place, "action", still(table["action"])), path)
    constant = np.asarray(still(table["action"]).to_pylist(), np.float32)
    width = constant.shape[1]
    exact = {name: [float(np.float32(2.1))] * width for name in ("min", "max", "mean")}
    restate(dataset, lambda stats: stats["action"].update(exact, std=[0.0013] * width))
    found = check_with_remarks(dataset)
    assert found.problems == []
    (remark,) = found.remarks
    assert remark.startswith("episode 0: std of 'action' is [0.0013, ")
    assert main(["check", str(dataset)]) == 0
    said = capsys.readouterr().out
    assert f"remark: {remark}" in said
    assert f"{dataset} is whole" in said
    restate(dataset, lambda stats: stats["action"].update(std=[0.02] * width))
    assert check_with_remarks(dataset).remarks == []
    assert "std of 'action' is [0.02" in check(dataset)[0]


@given(
    st.floats(-1e3, 1e3, width=32),
    st.sampled_from([0.0, 1e-6, 1e-3, 1.0]),
    st.integers(2, 3000),
    st.integers(0, 99),
)
def test_sums_in_single_precision_are_never_called_wrong(
    offset: float, spread: float, rows: int, seed: int
) -> None:
    noise = np.random.default_rng(seed).normal(0, spread, (rows, 1))
    known = (np.float32(offset) + noise).astype(np.float32)
    mean, std = single(known)
    exact = known.astype(np.float64)
    assert is_rounding_error("mean", mean, exact.mean(axis=0), exact)
    assert is_rounding_error("std", std.astype(np.float64), exact.std(axis=0), exact)
