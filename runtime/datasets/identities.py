"""Episodes of others get a uuid each, by which what is said of them is kept and travels with their dataset."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from uuid import NAMESPACE_URL, UUID, uuid5

import numpy as np
import pyarrow as pa

from runtime.core.errors import RecordingError
from runtime.datasets import layout
from runtime.datasets.assemble import Tell, silent
from runtime.datasets.catalog import Catalog
from runtime.datasets.operations import convert
from runtime.datasets.reader import Dataset, open_dataset
from runtime.datasets.staging import locked
from runtime.recording.base import IMPORTED
from runtime.recording.files import disk_fault, sync_folder, write_whole

_INDEX = ("index", "task_index")  # of a dataset, not of the episode


def named_copy(
    dataset: Path,
    target: Path,
    *,
    rename: Mapping[str, str] | None = None,
    reencode: bool = False,
    tell: Tell = silent,
) -> Dataset:
    """The dataset at `target`, with a uuid for each episode: a copy, or itself where both are one folder.

    What a copy leaves out is told.

    A copy keeps the version, v2.0 becomes v2.1; it appears whole or not at all. One that is there already is taken
    where its episodes have the same uuids, else RecordingError.
    """
    if target.resolve() == dataset.resolve():
        if rename:
            raise RecordingError(f"{dataset} keeps its names: import it under another one to rename features")
        Catalog.read(dataset)  # what our own tools cannot go on with is copied first
        with locked(dataset):
            _name(dataset)
    elif target.exists():
        _require_same(dataset, target)
    else:
        _copy(dataset, target, rename or {}, reencode, tell)
    return open_dataset(target)


def uuids_of(dataset: Path) -> dict[int, str]:
    """The uuid of each episode that has one, by index."""
    return {int(line["episode_index"]): str(line["uuid"]) for line in _told(dataset)}


def identity(dataset: Dataset, index: int, place: int | None = None) -> str:
    """A uuid that is of these rows: the same for the same numbers at the same index, whatever columns are called.

    `place`: the index that the episode has in a copy without gaps.
    """
    digests = []
    table = dataset.table(index)
    for name in table.column_names:
        if name in _INDEX or name in layout.image_keys(dataset.features):
            continue
        column = table[name].combine_chunks()
        while pa.types.is_list(column.type) or pa.types.is_fixed_size_list(column.type):
            column = column.flatten()
        if pa.types.is_floating(column.type):
            values = np.ascontiguousarray(column.to_numpy(zero_copy_only=False), np.float64)
            digests.append(hashlib.sha256(values.tobytes()).hexdigest())
    told = json.dumps([index if place is None else place, dataset.fps, table.num_rows, sorted(digests)])
    return str(uuid5(NAMESPACE_URL, f"eva-imported:{hashlib.sha256(told.encode()).hexdigest()}"))


def _copy(dataset: Path, target: Path, rename: Mapping[str, str], reencode: bool, tell: Tell) -> None:
    version = str(layout.read_info(dataset)["codebase_version"])
    draft = target.with_name(f".{target.name}.{IMPORTED}")
    try:
        shutil.rmtree(draft, ignore_errors=True)  # what a crash left
        made = convert(
            dataset,
            draft,
            version if version in layout.WRITABLE_VERSIONS else layout.DEFAULT_VERSION,
            rename=rename,
            reencode=reencode,
        )
        _name(draft)
        os.rename(draft, target)
        sync_folder(target.parent)
        for thing in made.left_out:
            tell(f"left out: {thing}")
    except OSError as error:
        raise disk_fault("importing into", target, error) from error
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def _name(root: Path) -> None:
    """Write a line for each episode that has none."""
    dataset, told = open_dataset(root), {int(line["episode_index"]): line for line in _told(root)}
    lines = [told.get(entry.index) or _line(dataset, entry.index) for entry in dataset.episodes]
    content = "".join(json.dumps(line, ensure_ascii=False) + "\n" for line in lines)
    write_whole(root / layout.EVA_EPISODES, content.encode())


def _line(dataset: Dataset, index: int) -> dict[str, Any]:
    entry = dataset.entry(index)
    return {
        "episode_index": index,
        "uuid": identity(dataset, index),
        "frames": entry.length,
        "task": ", ".join(entry.tasks),
        "kind": IMPORTED,
        "success": None,
        "result": None,
    }


def _require_same(dataset: Path, target: Path) -> None:
    source, known = open_dataset(dataset), uuids_of(dataset)
    wanted = {
        place: known.get(entry.index) or identity(source, entry.index, place)
        for place, entry in enumerate(source.episodes)
    }
    if uuids_of(target) != wanted:
        raise RecordingError(
            f"{target} is there and holds other episodes: import {dataset} under another name"
        )


def _told(root: Path) -> list[dict[str, Any]]:
    lines = layout.read_lines(root / layout.EVA_EPISODES)
    strange = next((line for line in lines if not _names_episode(line)), None)
    if strange is not None:
        raise RecordingError(f"{root / layout.EVA_EPISODES} has a line of no episode: {strange!r:.120}")
    return lines


def _names_episode(line: Mapping[str, Any]) -> bool:
    """True if it names an episode by a uuid: that becomes a folder, and the dataset's maker wrote it."""
    try:
        return "episode_index" in line and str(UUID(line["uuid"])) == line["uuid"]
    except (AttributeError, KeyError, TypeError, ValueError):
        return False
