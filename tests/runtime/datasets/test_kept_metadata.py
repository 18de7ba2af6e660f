"""What others say of their episodes beyond the format: splits, keys of their own, language columns."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from runtime.core.errors import RecordingError
from runtime.datasets import parquet_lists
from runtime.datasets.consistency import check
from runtime.datasets.episode_uuids import copy_with_uuids
from runtime.datasets.operations import convert, delete, merge, split
from runtime.datasets.publishing import publish
from runtime.datasets.reader import open_dataset
from runtime.datasets.splits import episodes_of, written
from tests.runtime.datasets.foreign import Plan, write
from tests.runtime.datasets.small import record

SPLITS = {"train": "0:3", "val": "3:5"}
LENGTHS = (3, 4, 3, 5, 3)


def tell(root: Path, **said: Any) -> None:
    path = root / "meta/info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | said))


def splits(root: Path) -> Any:
    return open_dataset(root).info["splits"]


def lines(root: Path) -> list[dict[str, Any]]:
    """The list of episodes of either version."""
    if open_dataset(root).version == "v3.0":
        return parquet_lists.read_episodes(root)
    return [json.loads(line) for line in (root / "meta/episodes.jsonl").read_text().splitlines()]


@pytest.fixture(params=["v2.1", "v3.0"])
def root(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """Five episodes in two splits, each with keys of its writer's own."""
    root, version = tmp_path / "set", request.param
    write(root, Plan(version, lengths=LENGTHS, videos=()))
    tell(root, splits=SPLITS, tools=[{"name": "say"}])
    if version == "v2.1":
        said = [line | {"operator": f"o{k}", "scene": {"cups": k}} for k, line in enumerate(lines(root))]
        (root / "meta/episodes.jsonl").write_text("".join(json.dumps(line) + "\n" for line in said))
    else:
        first = 0
        for path in sorted((root / "meta/episodes").rglob("*.parquet")):
            table = pq.read_table(path)
            numbers = range(first, first + table.num_rows)
            table = table.append_column("operator", pa.array([f"o{k}" for k in numbers]))
            table = table.append_column("scene", pa.array([{"cups": k} for k in numbers]))
            pq.write_table(table, path)
            first += table.num_rows
    return root


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_splits_and_own_keys_go_along_when_converted(root: Path, tmp_path: Path, version: str) -> None:
    assert check(root) == []
    done = convert(root, tmp_path / "new", version)
    assert (check(tmp_path / "new"), done.left_out) == ([], ())
    assert splits(tmp_path / "new") == SPLITS
    assert open_dataset(tmp_path / "new").info["tools"] == [{"name": "say"}]
    told = [(line["operator"], line["scene"]) for line in lines(tmp_path / "new")]
    assert told == [(f"o{k}", {"cups": k}) for k in range(5)]


def test_splits_and_own_keys_are_renumbered_when_episodes_are_deleted(root: Path) -> None:
    delete(root, [1, 3])
    assert splits(root) == {"train": "0:2", "val": "2:3"}
    assert [(line["episode_index"], line["operator"]) for line in lines(root)] == [
        (0, "o0"),
        (1, "o2"),
        (2, "o4"),
    ]
    delete(root, [2])
    assert (splits(root), check(root)) == ({"train": "0:2"}, [])


def test_splits_and_own_keys_are_those_of_the_parts_when_split_and_merged(root: Path, tmp_path: Path) -> None:
    one, other = tmp_path / "one", tmp_path / "other"
    split(root, {one: [0, 4], other: [3, 1]})
    assert (splits(one), splits(other)) == ({"train": "0:1", "val": "1:2"}, {"val": "0:1", "train": "1:2"})
    tell(other, tools=[], station="b")
    done = merge([one, other], tmp_path / "both")
    assert splits(tmp_path / "both") == {"train": "0:1,3:4", "val": "1:3"}
    assert [line["operator"] for line in lines(tmp_path / "both")] == ["o0", "o4", "o3", "o1"]
    assert done.left_out == (
        f"'tools' in info.json of {one}: others say another",
        f"'station' in info.json of {other}: others say another",
        f"'tools' in info.json of {other}: others say another",
    )
    assert check(tmp_path / "both") == []


def test_a_split_that_names_no_episodes_is_named(root: Path, tmp_path: Path) -> None:
    tell(root, splits={"train": "0:3", "val": "the rest", "test": "4:6"})
    said = "split 'val' is 'the rest', expected episodes such as '0:40' or '0:3,5:8'"
    assert check(root) == [
        f"info.json: {said}",
        "info.json: splits name episode 5 for 'test', which is not there",
        "info.json: splits leave out 1 episodes, the first is 3",
    ]
    done = convert(root, tmp_path / "new", "v2.1")
    assert done.left_out == (f"{root}: {said}",)
    assert splits(tmp_path / "new") == {"train": "0:3", "test": "4:5"}


def test_an_episode_that_is_published_is_for_training_and_changes_no_other_split(tmp_path: Path) -> None:
    root = tmp_path / "set"
    for seed in (1, 2):
        publish(record(tmp_path / "episodes", frames=3, seed=seed), root)
    tell(root, splits={"train": "0:1", "val": "1:2"})
    publish(record(tmp_path / "episodes", frames=3, seed=3), root)
    assert splits(root) == {"train": "0:1,2:3", "val": "1:2"}
    assert check(root) == []


def test_what_an_imported_copy_leaves_out_is_told(root: Path, tmp_path: Path) -> None:
    tell(root, splits={"train": "0:5", "val": "?"})
    said: list[str] = []
    copy_with_uuids(root, tmp_path / "copy", tell=said.append)
    assert splits(tmp_path / "copy") == {"train": "0:5"}
    assert said == [f"left out: {root}: split 'val' is '?', expected episodes such as '0:40' or '0:3,5:8'"]


def test_ranges_are_read_in_any_way_and_written_in_one() -> None:
    assert episodes_of("a", "0:2, 5") == episodes_of("a", [0, 1, 5]) == [0, 1, 5]
    assert written({"a": [5, 0, 1], "b": []}) == {"a": "0:2,5:6"}
    for odd in ("x", "3:", "-1:2", 3, None, [None]):
        with pytest.raises(RecordingError, match="split 'a' is"):
            episodes_of("a", odd)


def test_own_keys_that_the_other_version_cannot_hold_are_left_out_with_a_word(tmp_path: Path) -> None:
    root = tmp_path / "set"
    write(root, Plan("v2.1", lengths=(3, 4), videos=()))
    mixed = [line | {"odd": odd, "note": None} for line, odd in zip(lines(root), (1, "one"), strict=True)]
    (root / "meta/episodes.jsonl").write_text("".join(json.dumps(line) + "\n" for line in mixed))
    done = convert(root, tmp_path / "new", "v3.0")
    assert done.left_out == ("'odd' of the episodes: it cannot be written as parquet",)
    assert [line["note"] for line in lines(tmp_path / "new")] == [None, None]


def test_an_unsaid_number_is_null_where_json_has_no_other_word(tmp_path: Path) -> None:
    root = tmp_path / "set"
    write(root, Plan(lengths=(3, 4), videos=()))
    path = root / "meta/episodes/chunk-000/file-000.parquet"
    pq.write_table(pq.read_table(path).append_column("score", pa.array([float("nan"), 2.0])), path)
    convert(root, tmp_path / "new", "v2.1")
    assert [line["score"] for line in lines(tmp_path / "new")] == [None, 2.0]


def events(rows: list[list[dict[str, Any]] | None]) -> pa.Array:
    """`language_events` of LeRobot 0.6: a list of structs per row, or null; calls of tools are JSON."""
    said = [one for row in rows for one in row or ()]
    json_of = pa.ExtensionArray.from_storage(
        pa.json_(), pa.array([c for one in said for c in one["tool_calls"]])
    )
    ends = [0]
    for one in said:
        ends.append(ends[-1] + len(one["tool_calls"]))
    calls = pa.ListArray.from_arrays(pa.array(ends, pa.int32()), json_of)
    structs = pa.StructArray.from_arrays(
        [pa.array([one[name] for one in said], pa.string()) for name in ("role", "content")] + [calls],
        fields=[
            pa.field("role", pa.string(), nullable=False),
            pa.field("content", pa.string()),
            pa.field("tool_calls", calls.type),
        ],
    )
    starts = [None if row is None else sum(len(one or ()) for one in rows[:k]) for k, row in enumerate(rows)]
    return pa.ListArray.from_arrays(pa.array([*starts, len(said)], pa.int32()), structs)


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_columns_of_language_are_kept(tmp_path: Path, version: str) -> None:
    root = tmp_path / "set"
    write(root, Plan("v2.1", lengths=(3, 4), videos=()))
    features = json.loads((root / "meta/info.json").read_text())["features"]
    tell(root, features=features | {"language_events": {"dtype": "language", "shape": [1], "names": None}})
    row = {"role": "user", "content": "now the cup", "tool_calls": ['{"say": 1}', "{}"]}
    rows = {index: [[row, row], None, [], [row]][:length] for index, length in enumerate((3, 4))}
    for index, made in rows.items():
        path = root / f"data/chunk-000/episode_{index:06d}.parquet"
        pq.write_table(pq.read_table(path).append_column("language_events", events(made)), path)
    assert check(root) == []
    done = convert(root, tmp_path / "new", version)
    assert (check(tmp_path / "new"), done.left_out) == ([], ())
    merge([tmp_path / "new"], tmp_path / "again")
    for index, made in rows.items():
        assert open_dataset(tmp_path / "again").table(index)["language_events"].to_pylist() == made
        assert open_dataset(tmp_path / "again").episode(index).length == len(made)


def test_subtasks_that_are_numbered_otherwise_are_not_merged(tmp_path: Path) -> None:
    roots = [tmp_path / "one", tmp_path / "other"]
    for root in roots:
        write(root, Plan("v2.1", lengths=(3,), videos=()))
        features = json.loads((root / "meta/info.json").read_text())["features"]
        tell(root, features=features | {"subtask_index": {"dtype": "int64", "shape": [1], "names": None}})
        path = root / "data/chunk-000/episode_000000.parquet"
        pq.write_table(pq.read_table(path).append_column("subtask_index", pa.array([0, 0, 1])), path)
        pq.write_table(pa.table({"subtask": ["reach", "grasp"]}), root / "meta/subtasks.parquet")
    merge(roots, tmp_path / "both")
    assert pq.read_table(tmp_path / "both/meta/subtasks.parquet")["subtask"].to_pylist() == ["reach", "grasp"]
    pq.write_table(pa.table({"subtask": ["grasp", "reach"]}), roots[1] / "meta/subtasks.parquet")
    with pytest.raises(RecordingError, match=r"meta/subtasks\.parquet differ"):
        merge(roots, tmp_path / "never")


@pytest.mark.parametrize("name", ["meta/modality.json", "meta/subtasks.parquet"])
def test_a_file_of_the_first_source_is_kept_and_another_one_of_the_second_is_named(
    tmp_path: Path, name: str
) -> None:
    roots = [tmp_path / "one", tmp_path / "other"]
    for root in roots:
        write(root, Plan("v2.1", lengths=(3,), videos=()))
        (root / name).write_bytes(b"the same")
    assert merge(roots, tmp_path / "both").left_out == ()
    (roots[1] / name).write_bytes(b"another")

    assert merge(roots, tmp_path / "again").left_out == (str(roots[1] / name),)
    assert (tmp_path / "again" / name).read_bytes() == b"the same"


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_own_keys_are_kept_whatever_they_begin_with(tmp_path: Path, version: str) -> None:
    write(tmp_path / "set", Plan("v2.1", lengths=(3, 4), videos=()))
    own = {"__operator": "ann", "data/source": "bench", "videos/quality": "good"}
    said = [line | own for line in lines(tmp_path / "set")]
    (tmp_path / "set/meta/episodes.jsonl").write_text("".join(json.dumps(line) + "\n" for line in said))
    made = convert(tmp_path / "set", tmp_path / "new", version)
    assert made.left_out == ()
    assert [{key: line[key] for key in own} for line in lines(tmp_path / "new")] == [own] * 2
    assert check(tmp_path / "new") == []


def test_two_lines_about_one_episode_are_refused(tmp_path: Path) -> None:
    publish(record(tmp_path / "episodes", frames=4), tmp_path / "set")
    path = tmp_path / "set/meta/eva_episodes.jsonl"
    path.write_text(path.read_text() * 2)
    with pytest.raises(
        RecordingError, match=r"eva_episodes.jsonl has more than one line about the episodes \[0\]"
    ):
        convert(tmp_path / "set", tmp_path / "new", "v3.0")
