"""Uuids for the episodes of foreign datasets, to which reviews refer and which travel with the dataset."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any
from uuid import NAMESPACE_URL, UUID, uuid5

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from runtime.core.durable_files import sync_folder
from runtime.core.errors import RecordingError
from runtime.datasets import layout
from runtime.datasets.assemble import ProgressCallback, ignore_progress
from runtime.datasets.catalog import Catalog
from runtime.datasets.entries import EpisodeEntry
from runtime.datasets.operations import convert
from runtime.datasets.reader import Dataset, open_dataset
from runtime.datasets.rows import is_list
from runtime.datasets.staging import lock_dataset
from runtime.datasets.video_frames import StoredImages, VideoFrames, VideoSegment
from runtime.recording.base import IMPORTED
from runtime.recording.files import disk_error, write_atomic

_PLACES = ("index", "episode_index", "task_index")  # columns that depend on the dataset, not on the episode


def copy_with_uuids(
    dataset: Path,
    target: Path,
    *,
    rename: Mapping[str, str] | None = None,
    reencode: bool = False,
    tell: ProgressCallback = ignore_progress,
) -> Dataset:
    """Return the dataset at `target`, in which each episode has a uuid.

    It is a copy of `dataset`, or `dataset` itself if both are the same folder. A copy keeps the version, except that
    v2.0 becomes v2.1; it appears complete or not at all. An existing `target` is used if its episodes have the same
    uuids.

    Args:
        dataset: Folder of the dataset.
        target: Folder of the copy.
        rename: New names of features.
        reencode: Allow images to be encoded anew if they cannot be copied.
        tell: Receives what the copy leaves out.

    Raises:
        RecordingError: `target` has other episodes, or the dataset cannot be copied.
    """
    if target.resolve() == dataset.resolve():
        if rename:
            raise RecordingError(f"{dataset} keeps its names: import it under another one to rename features")
        Catalog.read(
            dataset
        )  # raises if our tools cannot continue the dataset in place; it must be copied then
        with lock_dataset(dataset):
            _name(dataset)
    elif target.exists():
        _require_same(dataset, target, tell)
    else:
        _copy(dataset, target, rename or {}, reencode, tell)
    return open_dataset(target)


def uuids_of(dataset: Path) -> dict[int, str]:
    """Return by index the uuid of each episode that has one."""
    return {int(line["episode_index"]): str(line["uuid"]) for line in _recorded_lines(dataset)}


def content_uuid(dataset: Dataset, index: int, place: int | None = None) -> str:
    """Return a uuid derived from the episode's content: columns by name, tasks, encoded images.

    `index` is the episode's index in `dataset`. `place` is the index that the episode has in a copy without gaps; None
    means that it is `index`, too. Raises: RecordingError.
    """
    entry, table = dataset.entry(index), dataset.table(index)
    stored = layout.image_keys(dataset.features)
    digests = {
        name: _digest_column(table[name]) for name in table.column_names if name not in (*_PLACES, *stored)
    }
    for key in stored:
        pictures = StoredImages(f"{entry.data}, {key!r}", table[key].to_pylist(), dataset.root)
        rows = (pictures.row(row) for row in range(len(pictures)))
        digests[key] = _digest(b"" if row is None else row["bytes"] for row in rows)
    for key, span in entry.videos.items():
        stretch = None if span.start is None else VideoSegment(span.start, entry.length, dataset.fps)
        with VideoFrames(span.path, stretch) as video:
            digests[key] = _digest(video.coded())
    fields = [index if place is None else place, dataset.fps, table.num_rows, sorted(entry.tasks), digests]
    content = json.dumps(fields, sort_keys=True, ensure_ascii=True).encode()
    return str(uuid5(NAMESPACE_URL, f"eva-imported-2:{hashlib.sha256(content).hexdigest()}"))


def _digest_column(column: pa.ChunkedArray) -> str:
    values = column.combine_chunks()
    lengths = []
    while is_list(values.type):
        lengths.append(pc.list_value_length(values).to_pylist())
        values = values.flatten()
    if pa.types.is_temporal(values.type):
        values = values.view(pa.int64() if values.type.bit_width == 64 else pa.int32())
    if pa.types.is_floating(values.type):
        numbers = np.ascontiguousarray(values.to_numpy(zero_copy_only=False), np.float64)
        return _digest([repr(lengths).encode(), numbers.tobytes()])
    return _digest([repr(lengths).encode(), repr(values.to_pylist()).encode("utf-8", "surrogatepass")])


def _digest(parts: Iterable[bytes]) -> str:
    whole = hashlib.sha256()
    for part in parts:
        whole.update(hashlib.sha256(part).digest())
    return whole.hexdigest()


def _identity_of_numbers(dataset: Dataset, index: int, place: int) -> str:
    """Return the uuid that earlier versions of this program assigned to an episode.

    It depends only on the values in columns of floats, the number of rows, the rate, and `place`, the episode's index
    in the copy.
    """
    digests = []
    table = dataset.table(index)
    for name in table.column_names:
        if name in ("index", "task_index", *layout.image_keys(dataset.features)):
            continue
        column = table[name].combine_chunks()
        while pa.types.is_list(column.type) or pa.types.is_fixed_size_list(column.type):
            column = column.flatten()
        if pa.types.is_floating(column.type):
            values = np.ascontiguousarray(column.to_numpy(zero_copy_only=False), np.float64)
            digests.append(hashlib.sha256(values.tobytes()).hexdigest())
    text = json.dumps([place, dataset.fps, table.num_rows, sorted(digests)])
    return str(uuid5(NAMESPACE_URL, f"eva-imported:{hashlib.sha256(text.encode()).hexdigest()}"))


def _copy(
    dataset: Path, target: Path, rename: Mapping[str, str], reencode: bool, tell: ProgressCallback
) -> None:
    version = str(layout.read_info(dataset)["codebase_version"])
    draft = target.with_name(f".{target.name}.{IMPORTED}")
    try:
        shutil.rmtree(draft, ignore_errors=True)  # left by a crash
        result = convert(
            dataset,
            draft,
            version if version in layout.WRITABLE_VERSIONS else layout.DEFAULT_VERSION,
            rename=rename,
            reencode=reencode,
        )
        source = open_dataset(dataset)
        _name(draft, {place: (source, entry.index) for place, entry in enumerate(source.episodes)})
        os.rename(draft, target)
        sync_folder(target.parent)
        for thing in result.left_out:
            tell(f"left out: {thing}")
    except OSError as error:
        raise disk_error("importing into", target, error) from error
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def _name(root: Path, sources: Mapping[int, tuple[Dataset, int]] | None = None) -> None:
    """Write a line with a uuid for each episode that has none; `sources` has the episode that each was copied from."""
    dataset, recorded = (
        open_dataset(root),
        {int(line["episode_index"]): line for line in _recorded_lines(root)},
    )
    lines = []
    for entry in dataset.episodes:
        source, index = (sources or {}).get(entry.index, (dataset, entry.index))
        lines.append(recorded.get(entry.index) or _line(entry, content_uuid(source, index, entry.index)))
    content = "".join(json.dumps(line, ensure_ascii=False) + "\n" for line in lines)
    write_atomic(root / layout.EVA_EPISODES, content.encode())


def _line(entry: EpisodeEntry, uuid: str) -> dict[str, Any]:
    return {
        "episode_index": entry.index,
        "uuid": uuid,
        "frames": entry.length,
        "task": ", ".join(entry.tasks),
        "kind": IMPORTED,
        "success": None,
        "result": None,
    }


def _require_same(dataset: Path, target: Path, tell: ProgressCallback) -> None:
    source, source_uuids, target_uuids = open_dataset(dataset), uuids_of(dataset), uuids_of(target)
    conflict = RecordingError(
        f"{target} is there and holds other episodes: import {dataset} under another name"
    )
    if len(target_uuids) != len(source.episodes):
        raise conflict
    by_numbers = 0
    for place, entry in enumerate(source.episodes):
        uuid = source_uuids.get(entry.index) or content_uuid(source, entry.index, place)
        if target_uuids.get(place) == uuid:
            continue
        by_numbers += 1
        if entry.index in source_uuids or target_uuids.get(place) != _identity_of_numbers(
            source, entry.index, place
        ):
            raise conflict
    if by_numbers:
        tell(
            f"{target} was imported by a version that compared numbers alone, and is taken as it is: where pictures "
            f"or words of {dataset} differ, import it under another name"
        )


def _recorded_lines(root: Path) -> list[dict[str, Any]]:
    lines = layout.read_lines(root / layout.EVA_EPISODES)
    strange = next((line for line in lines if not _names_episode(line)), None)
    if strange is not None:
        raise RecordingError(f"{root / layout.EVA_EPISODES} has a line of no episode: {strange!r:.120}")
    return lines


def _names_episode(line: Mapping[str, Any]) -> bool:
    """Return True if the line has a valid uuid.

    The uuid comes from a foreign dataset and becomes the name of a folder.
    """
    try:
        return "episode_index" in line and str(UUID(line["uuid"])) == line["uuid"]
    except (AttributeError, KeyError, TypeError, ValueError):
        return False
