"""Puts the files of an episode into a dataset so that a crash at any moment leaves the old contents."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType

from runtime.datasets import layout
from runtime.datasets.catalog import Catalog
from runtime.errors import RecordingError
from runtime.recording.files import disk_fault, read_document, sync_folder, write_whole

FOLDER = ".publishing"  # hidden: readers that take every file below data/ do not look here
LOCK = ".lock"
PLAN = "plan.json"


@contextmanager
def locked(root: Path) -> Iterator[None]:
    """Hold the dataset for one publisher, waiting for another one to finish; creates the folder."""
    try:
        root.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(root / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except OSError as error:
        raise disk_fault("locking", root, error) from error
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def recover(root: Path) -> None:
    """Take back what an interrupted publication left; the caller holds the lock.

    The plan of that publication names its files. Those of an episode that info.json does not count are
    removed, and so is every line about it; the files of an episode that it counts stay, in either version:
    publishing that episode again completes it.
    """
    staging = root / FOLDER
    if not staging.exists():
        return
    plan = staging / PLAN
    if plan.exists():
        content = read_document(plan)
        index, files = content.get("episode_index"), content.get("files")
        if not isinstance(index, int) or not isinstance(files, list):
            raise RecordingError(f"{plan} is not ours: {content}. Remove {staging} by hand")
        _take_back(root, index, [root / str(name) for name in files])
    shutil.rmtree(staging)


def _take_back(root: Path, index: int, files: list[Path]) -> None:
    catalog = Catalog.read(root)
    if index < len(catalog.episodes):
        return
    for path in files:
        path.unlink(missing_ok=True)
    if not catalog.info:
        return
    documents = catalog.documents_before_data() | catalog.documents_after_data()
    for name in (layout.TASKS, layout.EPISODES_STATS, layout.STATS, layout.EVA_EPISODES, layout.EPISODES):
        write_whole(root / name, documents[name])


def require_empty(root: Path) -> None:
    """Raise RecordingError where a folder without info.json holds anything that is not ours to overwrite."""
    ours = {FOLDER, LOCK, "data", "videos", "meta"}
    foreign = sorted(entry.name for entry in root.iterdir() if entry.name not in ours)
    foreign += [
        str(path.relative_to(root))
        for folder in ("data", "videos")
        for path in sorted((root / folder).rglob("*"))
        if path.is_file()
    ]
    if foreign:
        raise RecordingError(f"{root} is no dataset and not empty (no {layout.INFO}, but {foreign[:5]})")


class Staging:
    """Files prepared beside the dataset's and then renamed into place, the big ones first, info.json last.

    Leaving the block without `place` takes everything back.
    """

    def __init__(self, root: Path, episode_index: int, data: list[Path]) -> None:
        self._root = root
        self._index = episode_index
        self._data = data
        self._folder = root / FOLDER

    def __enter__(self) -> Staging:
        self._folder.mkdir()
        plan = {
            "episode_index": self._index,
            "files": [str(path.relative_to(self._root)) for path in self._data],
        }
        write_whole(self._folder / PLAN, json.dumps(plan).encode())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        recover(self._root)

    def path(self, final: Path) -> Path:
        """Where to prepare the file that goes to `final`."""
        return self._folder / str(final.relative_to(self._root)).replace("/", "|")

    def place(self, before: dict[str, bytes], after: dict[str, bytes]) -> None:
        """Write the documents, sync everything, then rename: `before`, the data, `after` in their order."""
        try:
            for name, content in (before | after).items():
                self.path(self._root / name).write_bytes(content)
            order = (
                [self._root / name for name in before] + self._data + [self._root / name for name in after]
            )
            for final in order:
                final.parent.mkdir(parents=True, exist_ok=True)
                _sync(self.path(final))
            self._rename(order[:-1])
            self._rename(order[-1:])
        except OSError as error:
            raise disk_fault("publishing to", self._root, error) from error

    def _rename(self, order: list[Path]) -> None:
        for final in order:
            os.replace(self.path(final), final)
        folders = {folder for final in order for folder in final.parents if folder.is_relative_to(self._root)}
        for folder in sorted(folders, key=lambda folder: -len(folder.parts)):
            sync_folder(folder)


def _sync(path: Path) -> None:
    with open(path, "rb") as file:
        os.fsync(file.fileno())
