"""Check of a LeRobot dataset against its own metadata, file by file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from runtime.core.errors import RecordingError
from runtime.datasets import layout, parquet_lists
from runtime.datasets.entries import (
    EpisodeEntry,
    Span,
    entry,
    of_episodes,
    publishing,
    statistic_lines,
    task_lines,
)
from runtime.datasets.features import (
    INDEX_COLUMNS,
    LANGUAGE,
    WORDS,
    arrow_type,
    figure_shapes,
    holds_nothing,
    is_depth,
    is_language,
    picture_size,
    shape_problem,
    stored_features,
)
from runtime.datasets.rows import column_array, read_rows, row_shape
from runtime.datasets.sidecars import orphaned_sidecars
from runtime.datasets.splits import episodes_of
from runtime.datasets.stats import FIGURES, fault, finite
from runtime.datasets.video_frames import StoredImages, VideoFrames, VideoSegment

if TYPE_CHECKING:
    import pyarrow as pa

    from runtime.datasets.layout import Line

TOLERANCE = 1e-4  # LeRobot's tolerance between a row and its image [s]
_ROUNDING = 2.0**-24  # relative rounding error of single precision


class _Remark(str):
    """Sentence about something in a dataset that is unusual without being damage."""


@dataclass(frozen=True, slots=True)
class CheckResult:
    """Result of a check, in sentences.

    `problems` are contradictions between the files and the metadata. `remarks` are findings that are no damage.
    """

    problems: list[str]
    remarks: list[str]


def check(dataset: Path) -> list[str]:
    """Return all contradictions between the files of `dataset` and its metadata, one sentence each; [] if intact."""
    return check_with_remarks(dataset).problems


def check_with_remarks(dataset: Path) -> CheckResult:
    """Return the contradictions that `check` finds, and also remarks."""
    findings = _problems(Path(dataset))
    return CheckResult(
        [finding for finding in findings if not isinstance(finding, _Remark)],
        [str(finding) for finding in findings if isinstance(finding, _Remark)],
    )


def _problems(root: Path) -> list[str]:
    try:
        info = layout.read_info(root)
        v30 = info["codebase_version"] == layout.V30
        lines = parquet_lists.read_episodes(root) if v30 else layout.read_lines(root / layout.EPISODES)
        tasks = task_lines(root, info)
        statistics = {line["episode_index"]: line["stats"] for line in statistic_lines(root, info)}
        entries = [entry(root, info, line) for line in lines]
        return [
            *_totals(info, lines, tasks),
            *(_places(info, lines) if v30 else ()),
            *_declarations(info),
            *_episodes(root, info, entries, statistics, {line["task_index"] for line in tasks}),
            *_uncounted_files(root, info, entries),
            *_sides(root, lines),
        ]
    except RecordingError as error:
        return [str(error)]
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        return [f"the metadata of {root} are not of the format: {error!r}"]


def _totals(info: layout.Info, episodes: list[Line], tasks: list[Line]) -> Iterator[str]:
    expected: dict[str, Any] = {
        "total_episodes": len(episodes),
        "total_frames": sum(line["length"] for line in episodes),
        "total_tasks": len(tasks),
    }
    if info["codebase_version"] != layout.V30:
        chunks_size = int(info.get("chunks_size", layout.CHUNKS_SIZE))
        expected["total_videos"] = len(episodes) * len(layout.video_keys(info["features"]))
        expected["total_chunks"] = -(-len(episodes) // chunks_size)
    for key, value in expected.items():
        if info.get(key) != value:
            yield f"info.json says {key} {info.get(key)}, the lists give {value}"
    yield from _splits(info, {int(line["episode_index"]) for line in episodes})
    if [line["episode_index"] for line in episodes] != list(range(len(episodes))):
        yield f"the list of episodes does not have episodes 0 to {len(episodes) - 1} in order"
    if sorted(line["task_index"] for line in tasks) != list(range(len(tasks))):
        yield f"the list of tasks does not number them 0 to {len(tasks) - 1}"


def _splits(info: layout.Info, listed: set[int]) -> Iterator[str]:
    left = set(listed)
    for name, value in (info.get("splits") or {}).items():
        try:
            named = set(episodes_of(name, value))
        except RecordingError as error:
            yield f"info.json: {error}"
            continue
        if absent := sorted(named - listed):
            yield f"info.json: splits name episode {absent[0]} for {name!r}, which is not there"
        left -= named
    if left:
        yield f"info.json: splits leave out {len(left)} episodes, the first is {min(left)}"


def _places(info: layout.Info, episodes: list[Line]) -> Iterator[str]:
    """Yield contradictions in v3.0's list of episodes: rows must follow each other, and videos must be as long as
    rows.
    """
    first = 0
    for line in episodes:
        stated = line["dataset_from_index"], line["dataset_to_index"]
        if stated != (first, first + line["length"]):
            yield f"episode {line['episode_index']} is rows {stated}, expected {(first, first + line['length'])}"
        first += line["length"]
        for key in layout.video_keys(info["features"]):
            start, end = (float(line[f"videos/{key}/{edge}_timestamp"]) for edge in ("from", "to"))
            if abs(end - start - line["length"] / float(info["fps"])) > TOLERANCE:
                yield f"episode {line['episode_index']}: {key!r} is {start} to {end} s for {line['length']} rows"


def _declarations(info: layout.Info) -> Iterator[str]:
    for key, feature in info["features"].items():
        if "/" in key:
            yield f"feature {key!r} has a slash in its name"
        names, shape = feature.get("names"), list(feature["shape"])
        if feature["dtype"] in ("video", "image"):
            continue
        if not shape or holds_nothing(feature):
            yield f"feature {key!r} has shape {shape}: LeRobot reads lengths above 0 alone, of one number [1]"
        elif isinstance(names, list) and len(names) != shape[0]:
            yield f"feature {key!r} has {len(names)} names for shape {shape}"
    for key, dtype in INDEX_COLUMNS.items():
        if info["features"].get(key, {}).get("dtype") != dtype:
            yield f"feature {key!r} must be declared as {dtype}, is {info['features'].get(key)}"


def _episodes(
    root: Path, info: layout.Info, entries: list[EpisodeEntry], statistics: Mapping[int, Any], tasks: set[int]
) -> Iterator[str]:
    first = 0
    for listed in entries:
        try:
            table = read_rows(listed.data, listed.index if listed.shared else None)
            problems = [
                *_until_unreadable(_table(table, info, listed.index, listed.length, first)),
                *_until_unreadable(_timestamps(table, info)),
                *_values(table, info),
                *_stored_pictures(table, info, root),
                *_until_unreadable(_task_indices(table, tasks)),
                *_statistics(table, info, statistics.get(listed.index)),
            ]
            problems = list(dict.fromkeys(problems))
        except RecordingError as error:
            problems = [str(error)]
        for key, span in listed.videos.items():
            problems += _video(span, key, info, listed.length)
        yield from (type(problem)(f"episode {listed.index}: {problem}") for problem in problems)
        first += listed.length


def _table(table: pa.Table, info: layout.Info, index: int, length: int, first: int) -> Iterator[str]:
    columns = stored_features(info["features"])
    for key in sorted(set(columns) - set(table.column_names)):
        yield f"there is no column {key!r}, though info.json declares it"
    for key in sorted(set(table.column_names) - set(columns)):
        yield f"column {key!r} is declared nowhere in info.json: loaders pass it over, or refuse the dataset"
    for key, feature in columns.items():
        if key not in table.column_names or holds_nothing(feature):
            continue
        stored = table.schema.field(key).type
        if feature["dtype"] == LANGUAGE:
            if not is_language(stored):
                yield f"{key!r} is stored as {stored}, expected a list of structs with role and content"
            continue
        declared = arrow_type(key, feature)
        if not _same_type(stored, declared):
            yield f"{key!r} is stored as {stored}, declared {declared}"
    if table.num_rows != length:
        yield f"{table.num_rows} rows, listed are {length}"
    frames = np.arange(table.num_rows)
    expected = {
        "frame_index": frames,
        "episode_index": np.full(table.num_rows, index),
        "index": frames + first,
    }
    if "next.done" in table.column_names:
        expected["next.done"] = frames == table.num_rows - 1
    for key, values in expected.items():
        if key in table.column_names and not np.array_equal(column_array(table, key).reshape(-1), values):
            yield f"{key!r} is not {values[:2].tolist()} to {values[-1:].tolist()}"


def _until_unreadable(problems: Iterator[str]) -> Iterator[str]:
    try:
        yield from problems
    except RecordingError as error:
        yield str(error)


def _timestamps(table: pa.Table, info: layout.Info) -> Iterator[str]:
    if "timestamp" not in table.column_names or not table.num_rows:
        return
    stored = column_array(table, "timestamp").astype(np.float64)[:, :1].reshape(-1)
    expected = np.arange(table.num_rows) / float(info["fps"])
    allowed = TOLERANCE + np.spacing(np.float32(expected[-1]))  # plus float32's resolution
    near = np.abs(stored - expected) <= allowed
    if not near.all():
        row = int(near.argmin())
        yield f"'timestamp' is not k / fps: row {row} has {stored[row]:g}, expected {expected[row]:g} s"


def _values(table: pa.Table, info: layout.Info) -> Iterator[str]:
    """Yield a sentence per column with values that no loader converts to numbers: null, infinite, of another type."""
    for key, feature in stored_features(info["features"]).items():
        if key not in table.column_names or feature["dtype"] in ("image", LANGUAGE):
            continue
        column = table.column(key)
        if column.null_count:
            yield f"{key!r} is null in {_rows(column.is_null().to_numpy())}"
        if feature["dtype"] == "string" or holds_nothing(feature):
            continue
        try:
            values = column_array(table, key)
            wrong = shape_problem(key, feature, row_shape(table, key))
        except RecordingError as error:
            yield str(error)
            continue
        if wrong:
            yield wrong
        if (infinite := np.isinf(values.astype(np.float64)).any(axis=1)).any():
            yield f"{key!r} is infinite in {_rows(infinite)}"


def _stored_pictures(table: pa.Table, info: layout.Info, root: Path) -> Iterator[str]:
    for key in layout.image_keys(info["features"]):
        if key not in table.column_names:
            continue
        pictures = StoredImages(repr(key), table.column(key).to_pylist(), root)
        missing = np.array([pictures.is_missing(k) for k in range(len(pictures))], bool)
        if missing.any():
            yield f"{key!r} has no picture in {_rows(missing)}"
        for number in np.flatnonzero(~missing).tolist():
            try:
                wrong = _size_problem(
                    f"picture {number} of {key!r}", pictures.size(number), info["features"][key]
                )
            except RecordingError as error:
                wrong = str(error)
            if wrong:
                yield wrong
                break


def _rows(marked: np.ndarray[Any, Any]) -> str:
    return f"{int(marked.sum())} rows, the first is {int(marked.argmax())}"


def _size_problem(label: str, size: tuple[int, int], feature: Mapping[str, Any]) -> str:
    """Return a sentence if an image's height or width differs from the declaration, else ""."""
    declared = picture_size(feature)[:2]
    if size == declared:
        return ""
    turned = ": rows and columns are exchanged" if size == declared[::-1] else ""
    return f"{label} is {size[0]} rows by {size[1]} columns, declared {declared[0]} by {declared[1]}{turned}"


def _same_type(stored: pa.DataType, expected: pa.DataType) -> bool:
    import pyarrow as pa

    if pa.types.is_fixed_size_list(stored) and pa.types.is_fixed_size_list(expected):
        return bool(stored.value_type == expected.value_type and stored.list_size == expected.list_size)
    return bool(stored == expected)


def _task_indices(table: pa.Table, tasks: set[int]) -> Iterator[str]:
    if "task_index" not in table.column_names:
        return
    unknown = set(column_array(table, "task_index").reshape(-1).tolist()) - tasks
    if unknown:
        yield f"task_index {sorted(unknown)} is not in the list of tasks"


def _statistics(
    table: pa.Table, info: layout.Info, statistics: Mapping[str, Mapping[str, Any]] | None
) -> Iterator[str]:
    if info["codebase_version"] == layout.V20:
        return  # v2.0 has no statistics per episode
    if not statistics:
        yield f"no statistics in {layout.EPISODES_STATS if info['codebase_version'] == layout.V21 else 'meta'}"
        return
    for key in (*layout.video_keys(info["features"]), *layout.image_keys(info["features"])):
        yield from _picture_statistic(key, info["features"][key], statistics.get(key))
    for key, feature in stored_features(info["features"]).items():
        if feature["dtype"] in WORDS or key not in table.column_names or holds_nothing(feature):
            continue
        try:
            values = column_array(table, key).astype(np.float64)
        except RecordingError:
            continue  # reported by `_values`
        finite_rows = values[finite(values)]
        if key in statistics:
            yield from _column_statistic(key, feature, finite_rows, statistics[key])
        elif len(finite_rows) and "image" not in key and key not in INDEX_COLUMNS:
            yield f"{key!r} has no statistics"


def _picture_statistic(key: str, feature: Mapping[str, Any], statistic: Any) -> Iterator[str]:
    if statistic is None:
        yield f"{key!r} has no statistics"
    elif reason := fault(statistic, figure_shapes(feature)):
        yield f"statistics of {key!r}: {reason}"
    elif not is_depth(feature):  # the unit of depth is chosen by its writer
        for name in FIGURES:
            value = np.asarray(statistic[name], dtype=np.float64)
            if not ((value >= 0) & (value <= 1)).all():
                yield f"{name} of {key!r} is {value.reshape(-1).tolist()}, expected 0 to 1"


def _column_statistic(
    key: str, feature: Mapping[str, Any], finite_rows: np.ndarray[Any, Any], statistic: Any
) -> Iterator[str]:
    if reason := fault(statistic, figure_shapes(feature)):
        yield f"statistics of {key!r}: {reason}"
        return
    if list(statistic["count"]) != [len(finite_rows)]:
        yield f"count of {key!r} is {statistic['count']}, known are {len(finite_rows)} rows"
        return
    figures = {
        "min": finite_rows.min(axis=0),
        "max": finite_rows.max(axis=0),
        "mean": finite_rows.mean(axis=0),
        "std": finite_rows.std(axis=0),
    }
    for name, value in figures.items():
        stated = np.asarray(statistic[name], dtype=np.float64).reshape(-1)
        if stated.shape == value.shape and np.allclose(stated, value, rtol=1e-4, atol=1e-5):
            continue
        text = f"{name} of {key!r} is {stated.tolist()}, the rows give {value.tolist()}"
        if stated.shape == value.shape and is_rounding_error(name, stated, value, finite_rows):
            yield _Remark(f"{text}: no more off than sums in single precision")
        else:
            yield text


def is_rounding_error(
    name: str, given: np.ndarray[Any, Any], value: np.ndarray[Any, Any], known: np.ndarray[Any, Any]
) -> bool:
    """Return True if LeRobot's use of single precision explains the difference between two statistics of a column.

    LeRobot adds up float32 values, and computes the variance as E[x^2] - E[x]^2. The sum of n numbers in sequence has
    an error of at most n u sum|x|, u = 2^-24. Source: Higham, Accuracy and Stability of Numerical Algorithms, 2002,
    section 4.2. Such an error occurs three times in the variance: once in E[x^2] and twice in the square.

    Args:
        name: Name of the statistic; the result is False for any other than "mean" and "std".
        given: Statistic in the dataset.
        value: Statistic computed from the rows in double precision.
        known: Finite rows [N, ...] of the column.
    """
    share = len(known) * _ROUNDING
    if name == "mean":
        return bool((abs(given - value) <= share * abs(known).mean(axis=0)).all())
    if name == "std":
        return bool((abs(given**2 - value**2) <= 3 * share * (known**2).mean(axis=0)).all())
    return False


def _video(span: Span, key: str, info: layout.Info, length: int) -> Iterator[str]:
    fps = float(info["fps"])
    try:
        stretch = None if span.start is None else VideoSegment(span.start, length, fps)
        with VideoFrames(span.path, stretch) as pictures:
            size, times = pictures.size, np.array(pictures.times)
    except RecordingError as error:
        yield str(error)
        return
    try:
        wrong = _size_problem(repr(key), size, info["features"][key])
    except RecordingError as error:
        wrong = f"{key!r}: {error}"
    if wrong:
        yield wrong
    if len(times) != length:
        yield f"{key!r} has {len(times)} frames for {length} rows"
    off = np.abs(times - (span.start or 0.0) - np.arange(len(times)) / fps)
    if len(off) and off.max() > TOLERANCE:
        yield f"{key!r}: frame {int(off.argmax())} is {off.max():.6f} s off k / fps"


def _uncounted_files(root: Path, info: layout.Info, entries: list[EpisodeEntry]) -> Iterator[str]:
    """Yield a sentence per data file that belongs to no counted episode: LeRobot reads every parquet file below
    data/.
    """
    cut_off, total = publishing(root), int(info["total_episodes"])
    counted = {listed.data for listed in entries if listed.index != cut_off or listed.index < total}
    for path in sorted((root / "data").rglob("*.parquet")):
        if path not in counted:
            yield f"{path} belongs to no episode: publishing was interrupted; `repair` removes it"


def _sides(root: Path, episodes: list[Line]) -> Iterator[str]:
    recorded = of_episodes(layout.read_lines(root / layout.EVA_EPISODES), episodes)
    yield from orphaned_sidecars(root, {str(line["uuid"]) for line in recorded})
