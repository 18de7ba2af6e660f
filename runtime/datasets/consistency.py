"""Checks a LeRobot v2.1 dataset against what its own metadata promises, file by file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from runtime.datasets import layout
from runtime.datasets.features import INDEX_COLUMNS, arrow_type, stored
from runtime.errors import RecordingError

if TYPE_CHECKING:
    import pyarrow as pa


def check(dataset: Path) -> list[str]:
    """Everything in `dataset` that contradicts its metadata, one sentence each; [] where it is whole."""
    root = Path(dataset)
    try:
        info = layout.read_info(root)
        if info["codebase_version"] != layout.CODEBASE_VERSION:
            return [f"version is {info['codebase_version']}, checked is {layout.CODEBASE_VERSION}"]
        episodes, statistics, tasks = (
            layout.read_lines(root / name) for name in (layout.EPISODES, layout.EPISODES_STATS, layout.TASKS)
        )
        return [
            *_totals(info, episodes, tasks),
            *_declarations(info),
            *_episodes(root, info, episodes, statistics, {line["task_index"] for line in tasks}),
            *_strays(root, info),
        ]
    except RecordingError as error:
        return [str(error)]
    except (KeyError, TypeError, ValueError) as error:
        return [f"the metadata of {root} are not of the format: {error!r}"]


def _totals(info: layout.Info, episodes: list[dict[str, Any]], tasks: list[dict[str, Any]]) -> Iterator[str]:
    chunks_size = int(info.get("chunks_size", layout.CHUNKS_SIZE))
    expected = {
        "total_episodes": len(episodes),
        "total_frames": sum(line["length"] for line in episodes),
        "total_tasks": len(tasks),
        "total_videos": len(episodes) * len(layout.video_keys(info["features"])),
        "total_chunks": -(-len(episodes) // chunks_size),
        "splits": {"train": f"0:{len(episodes)}"},
    }
    for key, value in expected.items():
        if info.get(key) != value:
            yield f"info.json says {key} {info.get(key)}, the lists give {value}"
    if [line["episode_index"] for line in episodes] != list(range(len(episodes))):
        yield f"{layout.EPISODES} does not list episodes 0 to {len(episodes) - 1} in order"
    if sorted(line["task_index"] for line in tasks) != list(range(len(tasks))):
        yield f"{layout.TASKS} does not number its tasks 0 to {len(tasks) - 1}"


def _declarations(info: layout.Info) -> Iterator[str]:
    for key, feature in info["features"].items():
        if "/" in key:
            yield f"feature {key!r} has a slash in its name"
        names, shape = feature.get("names"), list(feature["shape"])
        if isinstance(names, list) and feature["dtype"] != "video" and len(names) != shape[0]:
            yield f"feature {key!r} has {len(names)} names for shape {shape}"
    for key, dtype in INDEX_COLUMNS.items():
        if info["features"].get(key, {}).get("dtype") != dtype:
            yield f"feature {key!r} must be declared as {dtype}, is {info['features'].get(key)}"


def _episodes(
    root: Path,
    info: layout.Info,
    episodes: list[dict[str, Any]],
    statistics: list[dict[str, Any]],
    tasks: set[int],
) -> Iterator[str]:
    by_index = {line["episode_index"]: line["stats"] for line in statistics}
    first = 0
    for line in episodes:
        index, length, stem = line["episode_index"], line["length"], line.get("file_stem")
        try:
            table = _read(layout.data_file(root, info, index, stem))
            problems = [
                *_table(table, info, index, length, first),
                *_task_indices(table, tasks),
                *_statistics(table, info, by_index.get(index)),
            ]
        except RecordingError as error:
            problems = [str(error)]
        for key in layout.video_keys(info["features"]):
            problems += _video(layout.video_file(root, info, key, index, stem), key, info, length)
        yield from (f"episode {index}: {problem}" for problem in problems)
        first += length


def _read(path: Path) -> pa.Table:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        return pq.ParquetFile(path).read()
    except (OSError, pa.ArrowException) as error:
        raise RecordingError(f"{path} cannot be read: {error}") from error


def _table(table: pa.Table, info: layout.Info, index: int, length: int, first: int) -> Iterator[str]:
    columns = stored(info["features"])
    if set(table.column_names) != set(columns):
        yield f"columns differ from the features: {sorted(set(table.column_names) ^ set(columns))}"
    for key, feature in columns.items():
        if key in table.column_names and not _same_type(
            table.schema.field(key).type, arrow_type(key, feature)
        ):
            yield f"{key!r} is stored as {table.schema.field(key).type}, declared {arrow_type(key, feature)}"
    if table.num_rows != length:
        yield f"{table.num_rows} rows, listed are {length}"
    numbers = np.arange(table.num_rows)
    expected = {
        "frame_index": numbers,
        "episode_index": np.full(table.num_rows, index),
        "index": numbers + first,
        "timestamp": (numbers / float(info["fps"])).astype(np.float32),
    }
    if "next.done" in table.column_names:
        expected["next.done"] = numbers == table.num_rows - 1
    for key, values in expected.items():
        if key in table.column_names and not np.array_equal(_array(table, key), values):
            yield f"{key!r} is not {values[:2].tolist()} to {values[-1:].tolist()}"


def _same_type(given: pa.DataType, expected: pa.DataType) -> bool:
    import pyarrow as pa

    if pa.types.is_fixed_size_list(given) and pa.types.is_fixed_size_list(expected):
        return bool(given.value_type == expected.value_type and given.list_size == expected.list_size)
    return bool(given == expected)


def _task_indices(table: pa.Table, tasks: set[int]) -> Iterator[str]:
    if "task_index" not in table.column_names:
        return
    unknown = set(_array(table, "task_index").tolist()) - tasks
    if unknown:
        yield f"task_index {sorted(unknown)} is not in {layout.TASKS}"


def _statistics(
    table: pa.Table, info: layout.Info, statistics: Mapping[str, Mapping[str, Any]] | None
) -> Iterator[str]:
    if statistics is None:
        yield f"no line in {layout.EPISODES_STATS}"
        return
    for key in layout.video_keys(info["features"]):
        yield from _picture_statistic(key, statistics.get(key))
    for key, feature in stored(info["features"]).items():
        if feature["dtype"] == "string" or key not in table.column_names:
            continue
        values = _array(table, key).astype(np.float64).reshape(table.num_rows, -1)
        known = values[~np.isnan(values).any(axis=1)]
        if key in statistics:
            yield from _column_statistic(key, known, statistics[key])
        elif len(known) and "image" not in key and key not in INDEX_COLUMNS:
            yield f"{key!r} has no statistics"


def _picture_statistic(key: str, statistic: Mapping[str, Any] | None) -> Iterator[str]:
    if statistic is None:
        yield f"{key!r} has no statistics"
        return
    for name in ("min", "max", "mean", "std"):
        value = np.asarray(statistic[name], dtype=np.float64)
        if value.shape != (3, 1, 1) or not ((value >= 0) & (value <= 1)).all():
            yield f"{name} of {key!r} has shape {value.shape}, expected (3, 1, 1) in 0 to 1"


def _column_statistic(key: str, known: np.ndarray[Any, Any], statistic: Mapping[str, Any]) -> Iterator[str]:
    if list(statistic["count"]) != [len(known)]:
        yield f"count of {key!r} is {statistic['count']}, known are {len(known)} rows"
        return
    figures = {
        "min": known.min(axis=0),
        "max": known.max(axis=0),
        "mean": known.mean(axis=0),
        "std": known.std(axis=0),
    }
    for name, value in figures.items():
        given = np.asarray(statistic[name], dtype=np.float64)
        if given.shape != value.shape or not np.allclose(given, value, rtol=1e-4, atol=1e-5):
            yield f"{name} of {key!r} is {given.tolist()}, the rows give {value.tolist()}"


def _array(table: pa.Table, key: str) -> np.ndarray[Any, Any]:
    import pyarrow as pa

    column = table.column(key).combine_chunks()
    nested = pa.types.is_list(column.type) or pa.types.is_fixed_size_list(column.type)
    return np.asarray((column.flatten() if nested else column).to_numpy(zero_copy_only=False))


def _video(path: Path, key: str, info: layout.Info, length: int) -> Iterator[str]:
    import av

    if not path.is_file():
        yield f"there is no {path}"
        return
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            size = [stream.height, stream.width, 3]
            times = sorted(
                p.pts * (stream.time_base or Fraction(1))
                for p in container.demux(stream)
                if p.size and p.pts is not None
            )
    except (av.FFmpegError, IndexError) as error:
        yield f"{path} cannot be read: {error}"
        return
    if size != list(info["features"][key]["shape"]):
        yield f"{key!r} is {size}, declared {info['features'][key]['shape']}"
    if len(times) != length:
        yield f"{key!r} has {len(times)} frames for {length} rows"
    off = np.abs(np.array([float(t) for t in times]) - np.arange(len(times)) / float(info["fps"]))
    if len(off) and off.max() > 1e-4:
        yield f"{key!r}: frame {int(off.argmax())} is {off.max():.6f} s off k / fps"


def _strays(root: Path, info: layout.Info) -> Iterator[str]:
    """Data files beyond those that are counted: LeRobot reads every parquet file below data/."""
    total = int(info["total_episodes"])
    listed = {
        line["episode_index"]: line.get("file_stem") for line in layout.read_lines(root / layout.EPISODES)
    }
    counted = {layout.data_file(root, info, index, listed.get(index)) for index in range(total)}
    for path in sorted((root / "data").rglob("*.parquet")):
        if path not in counted:
            yield f"{path} belongs to no episode: publishing was interrupted; `recover` removes it"
