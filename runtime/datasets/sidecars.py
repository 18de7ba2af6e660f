"""Sidecars of a dataset: files by episode with action streams, annotations and reviews, which loaders ignore."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from uuid import UUID

from runtime.core.errors import RecordingError
from runtime.datasets.catalog import Catalog
from runtime.datasets.layout import read_lines
from runtime.datasets.staging import lock_dataset, recover
from runtime.recording.files import write_atomic

FOLDER = "eva"  # outside data/ and meta/episodes/, because LeRobot reads every parquet file there
STREAMS = "streams"
SUFFIXES = {STREAMS: ".parquet", "annotations": ".jsonl", "reviews": ".jsonl"}


def sidecar_path(root: Path, kind: str, uuid: str) -> Path:
    """Return the path of a sidecar of the episode `uuid`. Raises: RecordingError for an invalid kind or uuid."""
    if kind not in SUFFIXES:
        raise RecordingError(f"{kind!r} is no kind of side file, there are {sorted(SUFFIXES)}")
    try:
        name = str(UUID(uuid))
    except ValueError:
        raise RecordingError(f"{uuid!r} is no uuid of an episode") from None
    return root / FOLDER / kind / f"{name}{SUFFIXES[kind]}"


def sidecar_paths(root: Path, uuid: str) -> dict[str, Path]:
    """Return the existing sidecars of one episode, by kind."""
    paths = {kind: sidecar_path(root, kind, uuid) for kind in SUFFIXES}
    return {kind: path for kind, path in paths.items() if path.is_file()}


def read_sidecars(given: Mapping[str, Path]) -> dict[str, bytes]:
    """Return the contents of sidecar files to publish by kind ("annotations", "reviews"); JSON Lines are checked."""
    return {kind: _content(kind, Path(path)) for kind, path in given.items()}


def attach_sidecar(dataset: Path, uuid: str, kind: str, source: Path | None) -> Path:
    """Store the file `source` as a sidecar of the published episode `uuid`; it replaces an older one.

    If `source` is None, the sidecar is removed.

    Raises:
        RecordingError: The episode is not in the dataset, or the file is not JSON Lines.
    """
    root = Path(dataset)
    target = sidecar_path(root, kind, uuid)
    if not root.is_dir():
        raise RecordingError(f"there is no dataset folder {root}")
    content = None if source is None else _content(kind, Path(source))
    with lock_dataset(root):
        recover(root)
        if Catalog.read(root).index_of(uuid) is None:
            raise RecordingError(f"{root} has no episode {uuid}")
        if content is None:
            target.unlink(missing_ok=True)
        else:
            target.parent.mkdir(parents=True, exist_ok=True)
            write_atomic(target, content)
    return target


def _content(kind: str, source: Path) -> bytes:
    if kind not in SUFFIXES or kind == STREAMS:
        attached = sorted(set(SUFFIXES) - {STREAMS})
        raise RecordingError(f"{kind!r} cannot be attached, only {attached}")
    if not source.is_file():
        raise RecordingError(f"there is no file {source} with {kind}")
    lines = read_lines(source)
    return b"".join(json.dumps(line, ensure_ascii=False).encode() + b"\n" for line in lines)


def orphaned_sidecars(root: Path, uuids: set[str]) -> Iterator[str]:
    """Yield a sentence for each sidecar whose episode is not in the dataset."""
    for path in sorted((root / FOLDER).glob("*/*")):
        if path.parent.name in SUFFIXES and path.stem not in uuids and not path.name.startswith("."):
            yield f"{path} is of an episode that is not in the dataset"
