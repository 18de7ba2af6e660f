"""Atomic writes of an episode into a dataset: a crash at any time leaves the old contents."""

from __future__ import annotations

import ctypes
import errno
import fcntl
import glob
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType

from runtime.core.durable_files import sync_folder
from runtime.core.errors import RecordingError
from runtime.datasets import layout
from runtime.datasets.catalog import Catalog
from runtime.recording.files import disk_error, read_json, write_atomic

FOLDER = layout.PUBLISHING
LOCK = ".lock"
_HERE, _RENAME_EXCHANGE = -100, 2  # AT_FDCWD and the flag of renameat2(2)


@contextmanager
def lock_dataset(root: Path) -> Iterator[None]:
    """Hold the writers' lock of the dataset within the context, after waiting for another writer.

    The folder is created if it does not exist.
    """
    try:
        root.mkdir(parents=True, exist_ok=True)
        descriptor = _lock(root)
    except OSError as error:
        raise disk_error("locking", root, error) from error
    try:
        yield
    finally:
        os.close(descriptor)


def _lock(root: Path) -> int:
    """Lock the folder `root` and return the lock file's descriptor.

    Another process may exchange the folder while this one waits; then the new folder is locked.
    """
    while True:
        descriptor = os.open(root / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        if (root / LOCK).exists() and os.path.samestat(os.fstat(descriptor), os.stat(root / LOCK)):
            return descriptor
        os.close(descriptor)


def recover(root: Path) -> None:
    """Undo an interrupted publication; the caller must hold the lock.

    The plan of that publication names the files of its episode. If info.json does not count the episode yet, these
    files are removed, and so are all lines about the episode. If info.json counts it, all files remain, whether they
    are from before or after the publication: publishing the episode again completes it.
    """
    staging = root / FOLDER
    if not staging.exists():
        return
    plan = root / layout.PUBLISHING_PLAN
    if plan.exists():
        content = read_json(plan)
        index, files = content.get("episode_index"), content.get("files")
        if not isinstance(index, int) or not isinstance(files, list):
            raise RecordingError(f"{plan} is not ours: {content}. Remove {staging} by hand")
        _take_back(root, index, [root / str(name) for name in files])
    shutil.rmtree(staging)


def _take_back(root: Path, index: int, files: list[Path]) -> None:
    if (root / layout.INFO).exists() and index < int(layout.read_info(root)["total_episodes"]):
        return
    catalog = Catalog.read(root)
    for path in files:
        path.unlink(missing_ok=True)
    if not catalog.info:
        return
    documents = catalog.documents_before_data() | catalog.documents_after_data()
    for name in documents:
        if name not in (layout.MODALITY, layout.INFO):
            write_atomic(root / name, documents[name])


def require_empty(root: Path) -> None:
    """Raise RecordingError if a folder without info.json contains foreign files."""
    own_names = {FOLDER, LOCK, "data", "videos", "meta", "eva"}
    foreign = sorted(entry.name for entry in root.iterdir() if entry.name not in own_names)
    foreign += [
        str(path.relative_to(root))
        for folder in ("data", "videos", "eva")
        for path in sorted((root / folder).rglob("*"))
        if path.is_file()
    ]
    if foreign:
        raise RecordingError(f"{root} is no dataset and not empty (no {layout.INFO}, but {foreign[:5]})")


class Draft:
    """Complete new dataset: written into a hidden folder next to `target`, then moved there by one rename.

    With `replacing` it is exchanged with the existing folder in one step; otherwise the target must not exist or be
    empty. Leaving the context without `commit` removes the draft; the draft of a killed process is removed by `repair`.
    """

    def __init__(self, target: Path, replacing: bool) -> None:
        self._target = target
        self._replacing = replacing
        self.folder = target

    def __enter__(self) -> Draft:
        self._require_free()
        parent = self._target.absolute().parent
        try:
            parent.mkdir(parents=True, exist_ok=True)
            self.folder = Path(tempfile.mkdtemp(prefix=_draft_prefix(self._target), dir=parent))
            self.folder.chmod(0o755)
            self._descriptor = _lock(self.folder)
        except OSError as error:
            raise disk_error("creating", self._target, error) from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.close(self._descriptor)
        if self.folder.exists():
            shutil.rmtree(self.folder)

    def _require_free(self) -> None:
        if self._replacing or not self._target.exists():
            return
        if not self._target.is_dir() or any(self._target.iterdir()):
            raise RecordingError(f"{self._target} is there already and not empty: give a folder that is not")

    def commit(self) -> None:
        """Sync all files and move them to the target.

        A dataset that is replaced is moved to `folder`, which is removed at the end of the context.
        """
        try:
            for path in sorted(self.folder.rglob("*")):
                if path.is_file():
                    _sync(path)
                else:
                    sync_folder(path)
            sync_folder(self.folder)
            if self._replacing:
                _exchange(self.folder, self._target)
            else:
                os.rename(self.folder, self._target)
            sync_folder(self._target.absolute().parent)
        except OSError as error:
            raise disk_error("putting in place", self._target, error) from error


def remove_drafts(target: Path) -> list[Path]:
    """Remove drafts of `target` that killed processes left; drafts that are still being written are locked and
    remain.
    """
    removed = []
    for folder in sorted(target.absolute().parent.glob(f"{glob.escape(_draft_prefix(target))}*")):
        try:
            descriptor = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder)
                removed.append(folder)
            except BlockingIOError:
                continue
            finally:
                os.close(descriptor)
        except OSError as error:
            raise disk_error("removing", folder, error) from error
    return removed


def _draft_prefix(target: Path) -> str:
    return f".{target.absolute().name}.draft-"


def _exchange(first: Path, second: Path) -> None:
    """Exchange two folders in one step, so that both paths exist at any moment. Raises: RecordingError, OSError."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.renameat2(_HERE, os.fsencode(first), _HERE, os.fsencode(second), _RENAME_EXCHANGE):
        number = ctypes.get_errno()
        if number in (errno.EINVAL, errno.ENOSYS):
            raise RecordingError(
                f"the file system of {second} cannot exchange folders: write the result to another folder"
            )
        raise OSError(number, os.strerror(number), str(second))


class Staging:
    """Files prepared next to the dataset's files and then renamed into place: data first, info.json last.

    Leaving the context without `commit` undoes everything.
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
        write_atomic(self._root / layout.PUBLISHING_PLAN, json.dumps(plan).encode())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        recover(self._root)

    def path(self, final: Path) -> Path:
        """Return the path at which to prepare the file for `final`."""
        return self._folder / str(final.relative_to(self._root)).replace("/", "|")

    def write(self, final: Path, content: bytes) -> None:
        """Prepare `content` for the path `final`."""
        try:
            self.path(final).write_bytes(content)
        except OSError as error:
            raise disk_error("publishing to", self._root, error) from error

    def commit(self, before: dict[str, bytes], after: dict[str, bytes]) -> None:
        """Write the documents, sync all files, then rename them to their final names.

        First the documents in `before` are renamed, then the data files, then the documents in `after`. Both arguments
        map names to contents. Raises RecordingError if the disk refuses.
        """
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
            raise disk_error("publishing to", self._root, error) from error

    def _rename(self, order: list[Path]) -> None:
        for final in order:
            os.replace(self.path(final), final)
        folders = {folder for final in order for folder in final.parents if folder.is_relative_to(self._root)}
        for folder in sorted(folders, key=lambda folder: -len(folder.parts)):
            sync_folder(folder)


def _sync(path: Path) -> None:
    with open(path, "rb") as file:
        os.fsync(file.fileno())
