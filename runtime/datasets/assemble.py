"""Assembly of a new dataset from episodes of other datasets, in either version: for convert, merge, split and
delete.
"""

from __future__ import annotations

import json
import math
import shutil
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from runtime.core.errors import RecordingError
from runtime.datasets import layout
from runtime.datasets.catalog import Catalog, new_info, single_file_line
from runtime.datasets.column_renaming import ColumnRenaming
from runtime.datasets.columns import column_statistics
from runtime.datasets.entries import entry, episode_lines, own_keys, statistic_lines, task_lines
from runtime.datasets.features import (
    LANGUAGE,
    WORDS,
    arrow_schema,
    feature_differences,
    figure_shapes,
    holds_nothing,
    shape_problem,
    stored_features,
)
from runtime.datasets.layout import Line
from runtime.datasets.parquet_lists import EPISODES_FOLDER, is_storable
from runtime.datasets.reader import Dataset, open_dataset
from runtime.datasets.rows import column_array, row_shape, write_table
from runtime.datasets.sidecars import FOLDER, sidecar_path, sidecar_paths
from runtime.datasets.splits import TRAIN, episodes_of, written
from runtime.datasets.staging import LOCK, Draft
from runtime.datasets.stats import Statistic, fault, picture_statistic, video_statistic
from runtime.datasets.video_frames import StoredImages
from runtime.datasets.video_segments import (
    NotCopyableError,
    copy_segment,
    encode_segment,
    extra_stream_kinds,
)
from runtime.recording.files import disk_error

if TYPE_CHECKING:
    import pyarrow as pa

_PLACED = ("episode_index", "index", "task_index")  # columns that depend on the position of an episode
_ROUNDED, _LOST = 2.0**-23, 1e-3  # tolerated change: relative to a number (float32), and to a column's range
_OURS = {layout.INFO, layout.EPISODES, layout.TASKS, layout.EPISODES_STATS, layout.STATS, layout.TASKS_V30}
_OURS |= {layout.EVA_EPISODES}
SUBTASKS = "meta/subtasks.parquet"  # LeRobot 0.6: subtasks by subtask_index
COPIED_FROM = "copied_from"  # key of our line about an episode: source of a copy; absent if published

ProgressCallback = Callable[[str], None]  # receives the progress as text


def ignore_progress(progress: str) -> None:
    """Do nothing; used as the callback if the caller needs no progress."""


@dataclass(frozen=True, slots=True)
class EpisodeRef:
    """One episode of a source dataset."""

    source: SourceDataset
    index: int


@dataclass(frozen=True, slots=True, eq=False)
class SourceDataset:
    """Dataset whose episodes are copied, with its metadata besides the list of episodes."""

    dataset: Dataset
    names: ColumnRenaming
    tasks: tuple[str, ...]  # ordered by task index
    lines: Mapping[int, Line]  # keys of the list of episodes beyond the format
    statistics: Mapping[int, Mapping[str, Statistic]]
    eva: Mapping[int, Line]

    @classmethod
    def open(cls, root: Path, names: ColumnRenaming | None = None) -> SourceDataset:
        """Open the dataset in `root` with the new `names` of its features.

        Raises: RecordingError if there is no dataset or the names do not fit.
        """
        dataset = open_dataset(root)
        names = names or ColumnRenaming({})
        names.require(dataset.features)
        eva = layout.read_lines(root / layout.EVA_EPISODES)
        statistics = statistic_lines(root, dataset.info)
        tasks = sorted(task_lines(root, dataset.info), key=lambda line: int(line["task_index"]))
        return cls(
            dataset,
            names,
            tuple(str(line["task"]) for line in tasks),
            {int(line["episode_index"]): own_keys(line) for line in episode_lines(root, dataset.info)},
            {line["episode_index"]: names.rename_keys(line["stats"]) for line in statistics},
            _each_once(root, eva),
        )

    @property
    def features(self) -> Mapping[str, Mapping[str, Any]]:
        """Features under their new names."""
        return self.names.rename_keys(self.dataset.features)

    def episode_refs(self, indices: Sequence[int] | None = None) -> list[EpisodeRef]:
        """Return the episodes with these indices, or all if `indices` is None.

        Raises: RecordingError if an episode does not exist.
        """
        if indices is None:
            return [EpisodeRef(self, listed.index) for listed in self.dataset.episodes]
        return [EpisodeRef(self, self.dataset.entry(index).index) for index in indices]


@dataclass(frozen=True, slots=True)
class AssemblyResult:
    """Result of an assembly.

    `encoded` names the videos that were encoded anew, `left_out` the content that was not copied.
    """

    dataset: Path
    version: str
    episodes: int
    frames: int
    encoded: tuple[str, ...]
    left_out: tuple[str, ...]


def assemble(
    target: Path,
    version: str,
    parts: Sequence[EpisodeRef],
    *,
    reencode: bool = False,
    replacing: bool = False,
    tell: ProgressCallback = ignore_progress,
) -> AssemblyResult:
    """Write the dataset `target` with `parts` as its episodes 0, 1, ...; it appears complete or not at all.

    Rows, statistics and tasks are copied from the sources. Encoded images are copied, one video per episode.

    Args:
        target: Folder of the new dataset.
        version: Version of the format to write.
        parts: Episodes, in their new order.
        reencode: Allow images to be encoded anew if they cannot be copied.
        replacing: Replace the dataset that exists at `target`.
        tell: Receives the progress.

    Raises:
        RecordingError: The parts do not belong together or cannot be written.
    """
    if version not in layout.WRITABLE_VERSIONS:
        raise RecordingError(f"version is {version!r}, written are {layout.WRITABLE_VERSIONS}")
    if not parts:
        raise RecordingError(f"{target} would have no episode")
    _require_same(parts)
    with Draft(Path(target), replacing) as draft:
        try:
            result = _Assembly(draft.folder, version, parts, reencode, not replacing).write(tell)
        except OSError as error:
            raise disk_error("assembling", draft.folder, error) from error
        draft.commit()
    return replace(result, dataset=Path(target))


def _require_same(parts: Sequence[EpisodeRef]) -> None:
    first = parts[0].source
    for source in _sources(parts)[1:]:
        left, right = first.dataset, source.dataset
        problems = [
            f"{name} is {stated!r}, there {right_value!r}"
            for name, stated, right_value in (
                ("robot_type", left.info.get("robot_type"), right.info.get("robot_type")),
                ("fps", left.fps, right.fps),
            )
            if stated != right_value
        ]
        problems += feature_differences(first.features, source.features)
        problems += [
            f"video {key!r} is {mine}, there {right_codec}"
            for key in layout.video_keys(first.features)
            if (mine := _codec(first, key)) != (right_codec := _codec(source, key))
        ]
        if "subtask_index" in first.features and _bytes(left, SUBTASKS) != _bytes(right, SUBTASKS):
            problems.append(f"{SUBTASKS} differ, so that a subtask_index would mean another subtask")
        if problems:
            raise RecordingError(
                f"{left.root} and {right.root} do not belong together: {'; '.join(problems)}"
            )
    uuids = Counter(part.source.eva[part.index]["uuid"] for part in parts if part.index in part.source.eva)
    duplicates = [uuid for uuid, count in uuids.items() if count > 1]
    if duplicates:
        raise RecordingError(f"the same episode would be there twice: {duplicates}")


def _bytes(dataset: Dataset, name: str) -> bytes | None:
    """Return the content of a file of the dataset, None if it does not exist."""
    path = dataset.root / name
    return path.read_bytes() if path.is_file() else None


def _codec(source: SourceDataset, key: str) -> Any:
    info = source.features.get(key, {}).get("info") or {}
    return {name: info.get(name) for name in ("video.codec", "video.pix_fmt")}


def _sources(parts: Sequence[EpisodeRef]) -> list[SourceDataset]:
    return list({id(part.source): part.source for part in parts}.values())


class _Assembly:
    """One new dataset that is being written into the folder `root`."""

    def __init__(
        self, root: Path, version: str, parts: Sequence[EpisodeRef], reencode: bool, copying: bool
    ) -> None:
        self._root = root
        self._copying = copying
        self._parts = parts
        self._reencode = reencode
        self._sources = _sources(parts)
        first = self._sources[0]
        self._left_out: dict[str, None] = {}  # ordered set
        self._features = {
            key: dict(feature) | ({} if list(feature["shape"]) else {"shape": [1]})
            for key, feature in first.features.items()
            if not self._empty(key, feature)
        }
        self._tasks = tuple(dict.fromkeys(task for source in self._sources for task in source.tasks))
        self._fps = first.dataset.fps
        self._info = new_info(
            self._common(),
            robot=first.dataset.info.get("robot_type"),
            fps=self._fps,
            features=self._features,
            version=version,
        )
        self._encoded: list[str] = []

    def _common(self) -> dict[str, Any]:
        """Return the entries of info.json that are equal in all sources.

        Other entries, unless they belong to the format, are reported as left out.
        """
        infos = [source.dataset.info for source in self._sources]
        for info, source in zip(infos, self._sources, strict=True):
            for key in sorted(set(info) - layout.INFO_KEYS):
                if any(compared.get(key) != info[key] for compared in infos):
                    self._left_out[f"{key!r} in info.json of {source.dataset.root}: others say another"] = (
                        None
                    )
        return {
            key: value
            for key, value in infos[0].items()
            if all(source_info.get(key) == value for source_info in infos)
        }

    def _splits(self) -> dict[str, str]:
        """Return the sources' splits with the episodes' new indices; episodes of a source without splits are for
        training.
        """
        splits: dict[str, list[int]] = {}
        for source in self._sources:
            named, stated = {}, source.dataset.info.get("splits") or {}
            for name, value in stated.items():
                try:
                    named[name] = set(episodes_of(name, value))
                except RecordingError as error:
                    self._left_out[f"{source.dataset.root}: {error}"] = None
            indices = [listed.index for listed in source.dataset.episodes]
            # If indices have gaps, splits that cover 0 to count - 1 refer to positions, as in LeRobot.
            counted = set().union(*named.values()) == set(range(len(indices)))
            for place, part in enumerate(self._parts):
                if part.source is source:
                    number = indices.index(part.index) if counted else part.index
                    for name in named or (TRAIN,):
                        if not named or number in named[name]:
                            splits.setdefault(name, []).append(place)
        return written(splits)

    def _episode_lines(self, lines: Sequence[Line]) -> list[Line]:
        """Return `lines`, the new list of episodes, with the additional keys that the sources' lists have.

        Additional keys are those that the format does not define. If the values of such a key cannot be written in this
        version of the format, the key is reported as left out.
        """
        v30 = self._info["codebase_version"] == layout.V30
        owns = [part.source.lines.get(part.index, {}) for part in self._parts]
        stored: list[Line] = [{} for _ in owns]
        for key in dict.fromkeys(key for own in owns for key in own):
            values = [_without_nan(own.get(key)) for own in owns]
            if is_storable(values) if v30 else _is_json(values):
                for line, own, value in zip(stored, owns, values, strict=True):
                    line |= {key: value} if key in own else {}
            else:
                kind = "parquet" if v30 else "JSON"
                self._left_out[f"{key!r} of the episodes: it cannot be written as {kind}"] = None
        return [own | line for own, line in zip(stored, lines, strict=True)]

    def _empty(self, key: str, feature: Mapping[str, Any]) -> bool:
        if holds_nothing(feature):
            self._left_out[f"feature {key!r}: its shape is {list(feature['shape'])}, it holds nothing"] = None
            return True
        return False

    def write(self, tell: ProgressCallback) -> AssemblyResult:
        lines, statistics, eva, first = [], [], [], 0
        for index, part in enumerate(self._parts):
            tell(f"episode {index + 1} of {len(self._parts)}")
            line = self._line(part, index, first)
            lines.append(line)
            statistics.append({"episode_index": index, "stats": self._episode(part, line, first)})
            fields = part.source.eva.get(part.index)
            if fields is not None:
                origin = {COPIED_FROM: part.source.dataset.root.absolute().name} if self._copying else {}
                eva.append(fields | {"episode_index": index} | origin)
                self._sides(part, str(fields["uuid"]))
            first += line["length"]
        tasks = tuple({"task_index": number, "task": task} for number, task in enumerate(self._tasks))
        listed = tuple(self._episode_lines(lines))
        catalog = Catalog(self._root, self._info, listed, tasks, tuple(statistics), tuple(eva))
        catalog = replace(catalog, info={**self._info, **catalog.totals(), "splits": self._splits()})
        try:
            documents = catalog.documents_before_data() | catalog.documents_after_data()
        except UnicodeEncodeError as error:
            raise RecordingError(
                f"the metadata say {error.object!r:.120}, which is no text: {error.reason}"
            ) from error
        for name, content in documents.items():
            path = self._root / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        self._copy_other_files() if self._copying else self._carry(self._sources[0])
        return AssemblyResult(
            self._root,
            catalog.version,
            len(lines),
            first,
            tuple(self._encoded),
            tuple(self._left_out),
        )

    def _line(self, part: EpisodeRef, index: int, first: int) -> Line:
        listed = part.source.dataset.entry(part.index)
        return single_file_line(self._info, index, list(listed.tasks), listed.length, first)

    def _episode(self, part: EpisodeRef, line: Line, first: int) -> dict[str, Statistic]:
        """Write rows and videos of one episode; return the episode's statistics."""
        placed = entry(self._root, self._info, line)
        table = self._table(part, line, first)
        placed.data.parent.mkdir(parents=True, exist_ok=True)
        write_table(table, placed.data)
        statistics = self._source_statistics(part)
        for key, span in placed.videos.items():
            span.path.parent.mkdir(parents=True, exist_ok=True)
            self._video(part, key, span.path, placed.length)
            if key not in statistics:
                statistics[key] = video_statistic(span.path, placed.length)
        for key in layout.image_keys(self._features):
            if key not in statistics:
                name = f"{part.source.dataset.root}, episode {part.index}, column {key!r}"
                statistic = picture_statistic(StoredImages(name, table.column(key).to_pylist(), self._root))
                if statistic is not None:
                    statistics[key] = statistic
        if self._info["codebase_version"] == layout.V21:
            statistics |= {key: _of_three(statistics[key]) for key in self._video_keys if key in statistics}
        return statistics | _fill_statistics(statistics, self._computed(part, table))

    @property
    def _video_keys(self) -> list[str]:
        return [*layout.video_keys(self._features), *layout.image_keys(self._features)]

    def _source_statistics(self, part: EpisodeRef) -> dict[str, Statistic]:
        """Return the statistics that the source has for an episode, without those that are computed anew."""
        statistics = {}
        for key, statistic in part.source.statistics.get(part.index, {}).items():
            if key not in self._features or key in _PLACED:
                continue
            if reason := fault(statistic, figure_shapes(self._features[key])):
                where = f"{part.source.dataset.root}, episode {part.index}"
                self._left_out[f"statistics of {where}, {key!r}: {reason}; they are made anew"] = None
            else:
                statistics[key] = statistic
        return statistics

    def _computed(self, part: EpisodeRef, table: pa.Table) -> dict[str, Statistic]:
        columns = {}
        for key, feature in stored_features(self._features).items():
            if feature["dtype"] in WORDS:
                continue
            if wrong := shape_problem(key, feature, row_shape(table, key)):
                raise RecordingError(f"{part.source.dataset.root}, episode {part.index}: {wrong}")
            rows = column_array(table, key, math.prod(feature["shape"]))
            columns[key] = rows.reshape(table.num_rows, *feature["shape"])
        return column_statistics(columns, {key: self._features[key] for key in columns})

    def _table(self, part: EpisodeRef, line: Line, first: int) -> pa.Table:
        """Return the rows of an episode with its new indices, with exactly the declared columns."""
        import pyarrow as pa

        source, index = part.source, part.index
        table = source.dataset.table(index)
        table = table.rename_columns([source.names.new_name(name) for name in table.column_names])
        columns = stored_features(self._features)
        missing = [key for key in columns if key not in table.column_names]
        if missing:
            raise RecordingError(
                f"{source.dataset.root}, episode {index} lacks the columns {missing}, it has {table.column_names}"
            )
        for name in table.column_names:
            if name not in columns and name not in source.features:
                self._left_out[f"column {name!r}: it is declared nowhere"] = None
        worded = [key for key, feature in columns.items() if feature["dtype"] == LANGUAGE]
        types = {key: table.schema.field(key).type for key in worded}
        rows, schema = table.num_rows, arrow_schema(self._features, types)
        fresh = {
            "episode_index": np.full(rows, line["episode_index"], np.int64),
            "index": np.arange(first, first + rows, dtype=np.int64),
            "task_index": self._task_numbers(part, column_array(table, "task_index").reshape(-1)),
        }
        arrays = []
        for field in schema:
            if field.name in fresh:
                arrays.append(pa.array(fresh[field.name], field.type))
            else:
                arrays.append(self._cast(part, table.column(field.name), field))
        return pa.Table.from_arrays(arrays, schema=schema)

    def _task_numbers(self, part: EpisodeRef, numbers: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        tasks = part.source.dataset.tasks
        unknown = sorted(set(numbers.tolist()) - set(tasks))
        if unknown:
            raise RecordingError(
                f"{part.source.dataset.root}, episode {part.index}: task_index {unknown} is no task, "
                f"there are {sorted(tasks)}"
            )
        numbered = {number: self._tasks.index(task) for number, task in tasks.items()}
        return np.array([numbered[number] for number in numbers.tolist()], np.int64)

    def _cast(self, part: EpisodeRef, column: pa.ChunkedArray, field: pa.Field) -> pa.Array:
        import pyarrow as pa
        import pyarrow.compute as pc

        array = column.combine_chunks()
        root, where = part.source.dataset.root, f"episode {part.index}, column {field.name!r}"
        if pa.types.is_struct(field.type):
            pictures = StoredImages(f"{root}, {where}", array.to_pylist(), root)
            return pa.array([pictures.row(k) for k in range(len(pictures))], field.type)
        nested = pa.types.is_list(array.type) or pa.types.is_fixed_size_list(array.type)
        if nested and not (pa.types.is_list(field.type) or pa.types.is_fixed_size_list(field.type)):
            if array.null_count or pc.any(pc.not_equal(pc.list_value_length(array), 1)).as_py():
                raise RecordingError(f"{root}, {where} has other than one value per row, declared is one")
            array = array.flatten()
        try:
            converted = array.cast(field.type)
        except pa.ArrowException as error:
            raise RecordingError(
                f"{root}, {where} is {array.type}, declared {field.type}: {error}"
            ) from error
        if changed := _changed(array, converted):
            raise RecordingError(
                f"{root}, {where} is {array.type}, declared {field.type}, which cannot hold {changed}: "
                "declare it as it is stored"
            )
        return converted

    def _video(self, part: EpisodeRef, key: str, target: Path, frames: int) -> None:
        span = part.source.dataset.entry(part.index).videos[part.source.names.old_name(key)]
        try:
            copy_segment(span, target, frames, self._fps)
        except NotCopyableError as error:
            if not self._reencode:
                raise RecordingError(
                    f"{error}. Code its pictures again with --reencode: they lose a little"
                ) from error
            encode_segment(span, target, frames, self._fps)
            self._encoded.append(f"{key} of episode {part.index} of {part.source.dataset.root}")
        for kind in sorted(extra_stream_kinds(span.path) - extra_stream_kinds(target)):
            self._left_out[f"{kind} of {span.path}: the video is written without it"] = None

    def _sides(self, part: EpisodeRef, uuid: str) -> None:
        for kind, path in sidecar_paths(part.source.dataset.root, uuid).items():
            target = sidecar_path(self._root, kind, uuid)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, target)

    def _copy_other_files(self) -> None:
        """Copy files that belong neither to the format nor to an episode if there is a single source; else report them.

        The list of subtasks is copied from the first source, and so is modality.json unless features are renamed.
        """
        first = self._sources[0]
        for source in self._sources:
            root = source.dataset.root
            for path in sorted([*root.glob("*"), *(root / "meta").glob("*")]):
                name = str(path.relative_to(root))
                if path.name.startswith(".") or name in _OURS or name in _folders(source):
                    continue
                if path.is_symlink() and not _is_its_own(path, root):
                    self._left_out[f"{path}: a link to {path.resolve()}, which is not of the dataset"] = None
                elif name in (layout.MODALITY, SUBTASKS):
                    if source is not first:
                        if _bytes(source.dataset, name) != _bytes(first.dataset, name):
                            self._left_out[str(path)] = None
                    elif name == SUBTASKS or source.names.empty:
                        shutil.copyfile(path, self._root / name)
                elif path.is_file() and len(self._sources) == 1:
                    shutil.copyfile(path, self._root / name)
                else:
                    self._left_out[str(path)] = None

    def _carry(self, source: SourceDataset) -> None:
        """Copy all files of the replaced folder except those of the format itself and those of its episodes."""
        root = source.dataset.root
        listed = source.dataset.episodes
        carried = {root / name for name in _OURS} | {root / LOCK}
        carried |= {
            path
            for episode in listed
            for path in (episode.data, *(span.path for span in episode.videos.values()))
        }
        carried |= {
            path
            for fields in source.eva.values()
            for path in sidecar_paths(root, str(fields["uuid"])).values()
        }
        carried |= set((root / EPISODES_FOLDER).rglob("*.parquet"))
        for path in sorted(root.rglob("*")):
            name = path.relative_to(root)
            if (
                path in carried
                or name.parts[0] == layout.PUBLISHING
                or (path.is_dir() and not path.is_symlink())
            ):
                continue
            target = self._root / name
            if not target.exists():
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(path, target, follow_symlinks=False)


def _each_once(root: Path, lines: Sequence[Line]) -> dict[int, Line]:
    """Return the lines by the index of their episode.

    Raises: RecordingError if two lines are about the same episode.
    """
    by_index = {line["episode_index"]: line for line in lines}
    if len(by_index) < len(lines):
        counts = Counter(line["episode_index"] for line in lines)
        duplicates = sorted(index for index, count in counts.items() if count > 1)
        raise RecordingError(
            f"{root / layout.EVA_EPISODES} has more than one line about the episodes {duplicates}"
        )
    return by_index


def _is_its_own(path: Path, root: Path) -> bool:
    """Return True if `path` belongs to the dataset at `root`.

    A path belongs to it if, with all links resolved, it is in the dataset's folder, or in the folder of blobs to which
    the files of a snapshot in the cache of the Hugging Face hub are links.
    """
    resolved = root.resolve()
    places = (resolved, resolved.parent.parent / "blobs")
    return any(path.resolve().is_relative_to(place) for place in places)


def _changed(original: pa.Array, converted: pa.Array) -> str:
    """Return a sentence about the first value that the conversion to another type has changed noticeably, else "".

    Changes by rounding to float32 are permitted.
    """
    before, after = (
        np.asarray(_leaves(array).to_numpy(zero_copy_only=False)) for array in (original, converted)
    )
    if before.dtype == after.dtype or not all(
        np.issubdtype(values.dtype, np.number) or values.dtype == bool for values in (before, after)
    ):
        return ""
    exact, stored = before.astype(np.float64), after.astype(np.float64)
    finite = np.isfinite(exact)
    spread = float(np.ptp(exact[finite])) if finite.any() else 0.0
    with np.errstate(invalid="ignore", over="ignore"):
        allowed = _LOST * spread if spread else _ROUNDED * np.maximum(np.abs(exact), 1.0)
        off = finite & ~(np.abs(stored - exact) <= allowed)
    return f"{exact[off][0]:.17g} ({stored[off][0]:.9g} would be left)" if off.any() else ""


def _leaves(array: pa.Array) -> pa.Array:
    import pyarrow as pa

    while (
        pa.types.is_list(array.type)
        or pa.types.is_fixed_size_list(array.type)
        or pa.types.is_large_list(array.type)
    ):
        array = array.flatten()
    return array


def _without_nan(value: Any) -> Any:
    """Replace NaN, which pandas uses for missing values, by None."""
    return None if isinstance(value, float) and math.isnan(value) else value


def _is_json(values: Sequence[Any]) -> bool:
    try:
        return bool(json.dumps(values, allow_nan=False, ensure_ascii=False).encode())
    except (TypeError, ValueError):
        return False


def _folders(source: SourceDataset) -> set[str]:
    """Return the names of a dataset's folders that contain only files of the format and of episodes."""
    root = source.dataset.root
    listed = source.dataset.episodes
    files = [
        path
        for episode in listed
        for path in (episode.data, *(span.path for span in episode.videos.values()))
    ]
    return {"meta", FOLDER, EPISODES_FOLDER, *(path.relative_to(root).parts[0] for path in files)}


def _of_three(statistic: Statistic) -> Statistic:
    """Return a statistic of a single channel with its figures repeated for three channels.

    Readers of v2.1 require three.
    """
    figures = (name for name in statistic if name != "count")
    return statistic | {name: (statistic[name] * 3)[:3] for name in figures}


def _fill_statistics(
    stored: Mapping[str, Statistic], computed: Mapping[str, Statistic]
) -> dict[str, Statistic]:
    """Return the statistic of each column: figures of `stored`, and the computed ones for those that are missing."""
    return {key: {**statistic, **stored.get(key, {})} for key, statistic in computed.items()}
