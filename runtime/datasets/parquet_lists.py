"""Lists of a v3.0 dataset as parquet files: episodes with their statistics, and tasks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from runtime.core.errors import RecordingError
from runtime.datasets import layout
from runtime.datasets.layout import Line

if TYPE_CHECKING:
    import pyarrow as pa

EPISODES_FOLDER = "meta/episodes"
CHUNK, FILE = "meta/episodes/chunk_index", "meta/episodes/file_index"  # columns that name the file of the row
_STATS = "stats/"
_PANDAS_INDEX = "__index_level_0__"


def read_episodes(root: Path) -> list[Line]:
    """Return the rows of meta/episodes without the statistics, in the order of the files."""
    lines: list[Line] = []
    for path in _files(root):
        names = [name for name in _schema(path).names if not name.startswith(_STATS)]
        place = _numbers(path)
        lines += [line | place for line in _plain(_read(path, names)).to_pylist()]
    return lines


def read_statistics(root: Path) -> list[Line]:
    """Return {"episode_index", "stats": {feature: {figure: nested list}}} for each row of meta/episodes."""
    lines = []
    for path in _files(root):
        names = [name for name in _schema(path).names if name.startswith(_STATS)]
        for row in _read(path, ["episode_index", *names]).to_pylist():
            statistics: dict[str, dict[str, Any]] = {}
            for name in names:
                key, _, figure = name.removeprefix(_STATS).rpartition("/")
                if row[name] is not None and key:
                    statistics.setdefault(key, {})[figure] = row[name]
            lines.append({"episode_index": row["episode_index"], "stats": statistics})
    return lines


def read_tasks(root: Path) -> list[Line]:
    """Return {"task_index", "task"} for each row of meta/tasks.parquet.

    LeRobot writes this file with pandas, as a frame whose index contains the tasks. The result is [] if there is no
    file.
    """
    path = root / layout.TASKS_V30
    if not path.is_file():
        return []
    table = _read(path, None)
    named = [name for name in ("task", _PANDAS_INDEX) if name in table.column_names]
    if "task_index" not in table.column_names or not named:
        raise RecordingError(
            f"{path} has columns {table.column_names}, expected task_index and the task ({_PANDAS_INDEX})"
        )
    tasks, numbers = table.column(named[0]).to_pylist(), table.column("task_index").to_pylist()
    return [{"task_index": n, "task": str(task)} for n, task in zip(numbers, tasks, strict=True)]


def episode_files(lines: Sequence[Line], statistics: Sequence[Line]) -> dict[str, bytes]:
    """Return the content of the files of meta/episodes, by name.

    Each of `lines` is a row of the file that the line names. The statistics of its episode are added to the row.
    """
    by_index = {line["episode_index"]: line["stats"] for line in statistics}
    files: dict[tuple[int, int], list[Line]] = {}
    for line in lines:
        flat = _flat(by_index.get(line["episode_index"], {}))
        files.setdefault((line[CHUNK], line[FILE]), []).append(line | flat)
    return {
        layout.EPISODES_V30.format(chunk_index=chunk, file_index=file): _episodes(rows)
        for (chunk, file), rows in files.items()
    }


def is_storable(values: Sequence[Any]) -> bool:
    """Return True if a column of a parquet file can store these values."""
    import pyarrow as pa

    try:
        return bool(_bytes(pa.table({"values": pa.array(values)})))
    except (pa.ArrowException, TypeError, ValueError, OverflowError):
        return False


def tasks_file(tasks: Iterable[Line]) -> bytes:
    """Return the content of meta/tasks.parquet, in the form in which pandas writes a frame with the task as index."""
    import json

    import pyarrow as pa

    tasks = list(tasks)
    table = pa.table(
        {
            "task_index": pa.array([line["task_index"] for line in tasks], pa.int64()),
            _PANDAS_INDEX: pa.array([line["task"] for line in tasks], pa.string()),
        }
    )
    column = {"metadata": None, "field_name": None, "name": None}
    pandas = {
        "index_columns": [_PANDAS_INDEX],
        "column_indexes": [
            column | {"pandas_type": "unicode", "numpy_type": "object", "metadata": {"encoding": "UTF-8"}}
        ],
        "columns": [
            column
            | {
                "name": "task_index",
                "field_name": "task_index",
                "pandas_type": "int64",
                "numpy_type": "int64",
            },
            column | {"field_name": _PANDAS_INDEX, "pandas_type": "unicode", "numpy_type": "object"},
        ],
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.2.3",
    }
    return _bytes(table.replace_schema_metadata({"pandas": json.dumps(pandas)}))


def _plain(table: pa.Table) -> pa.Table:
    """Return the table with times in nanoseconds as text, because Python has no type for them."""
    import pyarrow as pa

    for place, field in enumerate(table.schema):
        if pa.types.is_temporal(field.type) and getattr(field.type, "unit", "") == "ns":
            table = table.set_column(place, field.name, table.column(place).cast(pa.string()))
    return table


def _flat(statistics: Mapping[str, Mapping[str, Any]]) -> Line:
    return {
        f"{_STATS}{key}/{figure}": value
        for key, statistic in statistics.items()
        for figure, value in statistic.items()
    }


def _episodes(rows: list[Line]) -> bytes:
    import pyarrow as pa

    names = list(dict.fromkeys(name for row in rows for name in row))
    types = {"tasks": pa.list_(pa.string())}
    columns = {name: pa.array([row.get(name) for row in rows], types.get(name)) for name in names}
    return _bytes(pa.table(columns))


def _bytes(table: pa.Table) -> bytes:
    import pyarrow as pa
    import pyarrow.parquet as pq

    sink = pa.BufferOutputStream()
    pq.write_table(table, sink)
    content: bytes = sink.getvalue().to_pybytes()
    return content


def _files(root: Path) -> list[Path]:
    files = sorted((root / EPISODES_FOLDER).glob("*/*.parquet"))
    if not files:
        raise RecordingError(
            f"{root / EPISODES_FOLDER} has no chunk-000/file-000.parquet: no list of episodes"
        )
    return files


def _numbers(path: Path) -> Line:
    """Return the chunk and file numbers in the name of a file."""
    try:
        return {CHUNK: int(path.parent.name.split("-")[1]), FILE: int(path.stem.split("-")[1])}
    except (IndexError, ValueError):
        raise RecordingError(f"{path} is not named chunk-NNN/file-NNN.parquet") from None


def _schema(path: Path) -> pa.Schema:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        return pq.read_schema(path)
    except (OSError, pa.ArrowException) as error:
        raise RecordingError(f"{path} cannot be read: {error}") from error


def _read(path: Path, names: list[str] | None) -> pa.Table:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with pq.ParquetFile(path) as file:
            return file.read(columns=names)
    except (OSError, pa.ArrowException) as error:
        raise RecordingError(f"{path} cannot be read: {error}") from error
