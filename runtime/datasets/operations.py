"""Operations on whole datasets: conversion to another version, merge, split, deletion of episodes, repair."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

from runtime.core.durable_files import write_durably
from runtime.core.errors import RecordingError
from runtime.datasets import layout
from runtime.datasets.assemble import (
    AssemblyResult,
    EpisodeRef,
    ProgressCallback,
    SourceDataset,
    assemble,
    ignore_progress,
)
from runtime.datasets.column_renaming import ColumnRenaming
from runtime.datasets.consistency import check
from runtime.datasets.entries import episode_lines
from runtime.datasets.staging import LOCK, lock_dataset, recover, remove_drafts
from runtime.recording.files import disk_error


def convert(
    dataset: Path,
    target: Path,
    version: str,
    *,
    rename: Mapping[str, str] | None = None,
    reencode: bool = False,
    tell: ProgressCallback = ignore_progress,
) -> AssemblyResult:
    """Write `dataset` as the new dataset `target` of `version`, v2.1 or v3.0; `rename` has new names of features."""
    with _locked_datasets([dataset]):
        source = SourceDataset.open(Path(dataset), ColumnRenaming(dict(rename or {})))
        return assemble(target, version, source.episode_refs(), reencode=reencode, tell=tell)


def merge(
    datasets: Sequence[Path],
    target: Path,
    version: str | None = None,
    *,
    reencode: bool = False,
    tell: ProgressCallback = ignore_progress,
) -> AssemblyResult:
    """Write the episodes of `datasets`, in this order, as the new dataset `target`.

    Args:
        datasets: Folders of the datasets.
        target: Folder of the new dataset.
        version: Version to write; None: that of the first dataset, v2.1 for v2.0.
        reencode: Allow images to be encoded anew if they cannot be copied.
        tell: Receives the progress.

    Raises:
        RecordingError: The datasets do not belong together; the message names every difference.
    """
    if not datasets:
        raise RecordingError("no datasets to merge")
    with _locked_datasets(datasets):
        sources = [SourceDataset.open(Path(dataset)) for dataset in datasets]
        parts = [part for source in sources for part in source.episode_refs()]
        return assemble(target, version or _written_version(sources[0]), parts, reencode=reencode, tell=tell)


def select(
    chosen: Mapping[Path, Sequence[str]],
    target: Path,
    version: str | None = None,
    *,
    reencode: bool = False,
    provenance: Mapping[str, object] | None = None,
    tell: ProgressCallback = ignore_progress,
) -> AssemblyResult:
    """Write episodes of one or several datasets, named by their UUIDs, as the new dataset `target`.

    `provenance`, if given, is written into the new dataset as meta/eva_subset.json.

    Raises:
        RecordingError: A dataset lacks one of its episodes, or the datasets do not belong together.
    """
    if not chosen:
        raise RecordingError("no episodes to select")
    with _locked_datasets(list(chosen)):
        parts: list[EpisodeRef] = []
        for dataset, uuids in chosen.items():
            source = SourceDataset.open(Path(dataset))
            indices = {str(line["uuid"]): index for index, line in source.eva.items()}
            if missing := [uuid for uuid in uuids if uuid not in indices]:
                raise RecordingError(f"{dataset} has no episode {missing[0]} ({len(missing)} such)")
            parts += source.episode_refs([indices[uuid] for uuid in uuids])
        result = assemble(
            target, version or _written_version(parts[0].source), parts, reencode=reencode, tell=tell
        )
    if provenance is not None:
        text = json.dumps(provenance, indent=1, ensure_ascii=False)
        write_durably(target / layout.SUBSET, text.encode())
    return result


def split(
    dataset: Path,
    targets: Mapping[Path, Sequence[int]],
    version: str | None = None,
    *,
    reencode: bool = False,
    tell: ProgressCallback = ignore_progress,
) -> list[AssemblyResult]:
    """Write for each of `targets` a new dataset with the named episodes; an episode may be in several, or in none.

    Either all targets are written or none.

    Raises:
        RecordingError: A target exists or an episode does not; checked before anything is written.
    """
    if not targets:
        raise RecordingError(f"{dataset} is to be split into nothing")
    with _locked_datasets([dataset]):
        source = SourceDataset.open(Path(dataset))
        refs = {target: source.episode_refs(_unique(indices)) for target, indices in targets.items()}
        for target in refs:
            if target.exists() and any(target.iterdir()):
                raise RecordingError(f"{target} is there already and not empty")
        target_version = version or _written_version(source)
        results: list[AssemblyResult] = []
        try:
            for target, parts in refs.items():
                on_progress = partial(_of_part, tell, target.name)
                results.append(assemble(target, target_version, parts, reencode=reencode, tell=on_progress))
        except BaseException:  # all parts or none: a remaining part would block the next try
            for target in list(refs)[: len(results)]:
                shutil.rmtree(target)
            raise
        return results


def _of_part(tell: ProgressCallback, name: str, progress: str) -> None:
    tell(f"{name}: {progress}")


def delete(
    dataset: Path,
    indices: Sequence[int],
    *,
    reencode: bool = False,
    known: str = "",
    tell: ProgressCallback = ignore_progress,
) -> AssemblyResult:
    """Delete episodes of `dataset`; the indices of later episodes decrease.

    The folder is replaced in one step, so that it always contains either the old or the new dataset. `known` is the
    `fingerprint` of the dataset to which the indices refer; if the dataset has changed since, nothing is deleted.

    Raises:
        RecordingError: An episode does not exist, none would remain, or the dataset has changed.
    """
    root = Path(dataset).resolve()  # the folder is replaced, not a link to it
    _require_dataset(root)
    with lock_dataset(root):
        recover(root)
        if known and fingerprint(root) != known:
            raise RecordingError(
                f"{root} has other episodes now than when this was asked for: nothing was deleted; look again"
            )
        source = SourceDataset.open(root)
        gone = {part.index for part in source.episode_refs(_unique(indices))}
        left: list[EpisodeRef] = [part for part in source.episode_refs() if part.index not in gone]
        if not gone:
            raise RecordingError(f"no episodes of {root} to delete")
        return assemble(root, _written_version(source), left, reencode=reencode, replacing=True, tell=tell)


def fingerprint(dataset: Path) -> str:
    """Return a digest that changes if an episode is added, deleted or written again with another length.

    Raises:
        RecordingError: The metadata cannot be read.
    """
    root = Path(dataset)
    info = layout.read_info(root)
    stated = [
        [line["episode_index"], line["length"], list(line.get("tasks") or ())]
        for line in episode_lines(root, info)
    ]
    recorded = [
        [line["episode_index"], line["uuid"]] for line in layout.read_lines(root / layout.EVA_EPISODES)
    ]
    return hashlib.sha256(json.dumps([stated, recorded], ensure_ascii=True).encode()).hexdigest()


def repair(dataset: Path) -> list[str]:
    """Undo what a crash left incomplete; return the problems that `check` still finds, which `repair` cannot solve."""
    root = Path(dataset).resolve()
    remove_drafts(root)
    _require_dataset(root)
    with lock_dataset(root):
        recover(root)
    return check(root)


def _require_dataset(root: Path) -> None:
    if not root.is_dir():
        raise RecordingError(f"there is no dataset folder {root}")


def _written_version(source: SourceDataset) -> str:
    """Return the version of a dataset, or the default version for v2.0, which cannot be written."""
    version = source.dataset.version
    return version if version in layout.WRITABLE_VERSIONS else layout.DEFAULT_VERSION


def _unique(indices: Sequence[int]) -> Sequence[int]:
    duplicates = sorted({index for index in indices if list(indices).count(index) > 1})
    if duplicates:
        raise RecordingError(f"episodes {duplicates} are named twice")
    return indices


@contextmanager
def _locked_datasets(datasets: Sequence[Path]) -> Iterator[None]:
    """Lock `datasets` against publishers within the context.

    A dataset without a lock file has never been published to, and no lock file is created for it.
    """
    with ExitStack() as stack:
        for path in sorted({Path(dataset).absolute() / LOCK for dataset in datasets}):
            if not path.exists():
                continue
            try:
                descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
                stack.callback(os.close, descriptor)
                fcntl.flock(descriptor, fcntl.LOCK_SH)
            except OSError as error:
                raise disk_error("locking", path, error) from error
        yield
