"""Episodes of stations elsewhere on their way to the lab's disk: requested in pieces, verified, published at once.

DATA/episodes/.arriving/STATION/UUID/   part that has arrived; UUID.json: its list, UUID.declined: why it was declined
DATA/episodes/UUID/                     complete episode: moved here by one rename after every file was verified
DATA/arrivals/UUID                      episode or labels that have arrived and have no rows in the database yet

Each station has a thread of its own with the lowest priority: its transfers and hashing delay neither other stations
nor pictures. After a lost connection or a kill, at any byte, the transfer continues from the length of the files.
"""

from __future__ import annotations

import errno
import hashlib
import logging
import os
import shutil
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from queue import Empty, SimpleQueue

from runtime.core.durable_files import sync_folder
from runtime.core.errors import CodecError, RecordingError
from runtime.link.contents import MANIFEST, Contents, File, contents_of, is_episode, unpacked
from runtime.link.wire import PIECE, Arrived, Declined, Labels, Message, Offer, Piece, Want
from runtime.link.yielding import lower_priority
from runtime.recording.archive_index import stored_files
from runtime.recording.files import disk_error, read_json, write_atomic
from runtime.recording.labels import FOLDER as LABELS

log = logging.getLogger(__name__)
RESERVE = 5 << 30  # free space of the disk that episodes may not use [bytes]
LARGEST_LABELS = 1 << 20  # bytes
ARRIVING, ARRIVALS = ".arriving", "arrivals"
_WINDOW = 8  # pieces requested at once
_MOST_BEGUN = 3  # partial episodes per station
_MOST_DECLINED = 64  # refusals per station that are stored for the pages
_MOST_TRIES = 3  # per file whose content differs from the list
_SOON_S, _LATER_S, _NEVER_S = 60.0, 600.0, 86400.0  # [s], until the station may offer it again
Owner = Callable[[str], str]
"""Called with an episode's uuid; returns its station's name, "" if unknown. Raises: OSError if the lookup fails."""
ReadBack = Callable[[str], None]
"""Called with a SHA-256; reads that object of the lab's store. Raises: OSError if it is absent or another one."""


def _unread(digest: str) -> None:
    raise OSError(f"this program does not read the store, which should have {digest}")


@dataclass(frozen=True, slots=True)
class Progress:
    """Bytes of an episode that have arrived, and its size; `why`: reason if the lab has declined it."""

    here: int
    size: int
    why: str = ""


def progress_of(data: Path, station: str, uuid: str) -> Progress | None:
    """Return the progress of an episode of that station; None if it was never offered or has arrived."""
    begun = data / "episodes" / ARRIVING / station
    try:
        reason = _temporary_path(begun, uuid, "declined").read_text("utf-8")
    except OSError:
        reason = ""
    try:
        contents = unpacked(_temporary_path(begun, uuid, "json").read_bytes())
    except (OSError, CodecError):
        return Progress(0, 0, reason) if reason else None
    received = sum(min(_size(begun / uuid / file.name), file.size) for file in contents.files)
    return Progress(received, contents.size, reason)


def arrivals(data: Path) -> list[tuple[str, Path]]:
    """Return uuid and mark of each episode that has arrived, or whose labels have arrived.

    The caller removes the mark, a file, after writing the episode's rows to the database.
    """
    folder = data / ARRIVALS
    try:
        return [(path.name, path) for path in sorted(folder.iterdir()) if is_episode(path.name)]
    except FileNotFoundError:
        return []


class Incoming:
    """Receiver of the episodes of all stations. One thread calls `handle` and `left`.

    The event descriptor `wake` becomes readable when `answers` has messages to send.
    """

    def __init__(
        self, data: Path, owner: Owner, reserve: int = RESERVE, read_back: ReadBack = _unread
    ) -> None:
        self._data, self._owner, self._reserve, self._read_back = data, owner, reserve, read_back
        self._desks: dict[str, _Desk] = {}
        self._answers: SimpleQueue[tuple[bytes, Message]] = SimpleQueue()
        self.wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)

    def handle(self, station: str, route: bytes, message: Message, part: bytes) -> None:
        """Pass a station's message about an episode to the thread of that station."""
        if station not in self._desks:
            shelf = Shelf(self._data, station, self._owner, self._reserve, self._read_back)
            self._desks[station] = _Desk(shelf, self._send)
        self._desks[station].put(route, message, part)

    def left(self, station: str, route: bytes) -> None:
        """Record that a connection has ended: the pieces requested over it will not arrive."""
        if station in self._desks:
            self._desks[station].put(route, None, b"")

    def answers(self) -> list[tuple[bytes, Message]]:
        """Return the messages to send since the last call, each with its connection."""
        with suppress(BlockingIOError):
            os.eventfd_read(self.wake)
        answers = []
        with suppress(Empty):
            while True:
                answers.append(self._answers.get_nowait())
        return answers

    def end(self) -> None:
        """Stop all threads after their current messages."""
        for desk in self._desks.values():
            desk.end()
        os.close(self.wake)

    def _send(self, route: bytes, message: Message) -> None:
        self._answers.put((route, message))
        os.eventfd_write(self.wake, 1)


class _Desk:
    """Thread that handles the episodes of one station."""

    def __init__(self, shelf: Shelf, say: Callable[[bytes, Message], None]) -> None:
        self._shelf, self._say = shelf, say
        self._asked: SimpleQueue[tuple[bytes, Message | None, bytes] | None] = SimpleQueue()
        self._route = b""
        self._thread = threading.Thread(target=self._work, name=f"{shelf.station} episodes", daemon=True)
        self._thread.start()

    def put(self, route: bytes, message: Message | None, part: bytes) -> None:
        self._asked.put((route, message, part))

    def end(self) -> None:
        self._asked.put(None)
        self._thread.join()

    def _work(self) -> None:
        lower_priority()
        while (request := self._asked.get()) is not None:
            route, message, part = request
            if route != self._route or message is None:
                self._shelf.drop()
                self._route = route
            if message is None:
                continue
            for answer in self._answers(message, part):
                self._say(route, answer)
        self._shelf.drop()

    def _answers(self, message: Message, part: bytes) -> list[Message]:
        try:
            return list(self._shelf.handle(message, part))
        except Exception:
            log.exception("%s: an episode cannot be taken in", self._shelf.station)
            self._shelf.drop()
            episode = getattr(message, "episode", "")
            return [Declined(episode, "the lab cannot store it: see its log", _LATER_S)]


@dataclass(slots=True)
class _Begun:
    """Episode that is being received, with its current file and the requested pieces."""

    episode: str
    contents: Contents
    folder: Path
    number: int = 0
    descriptor: int = -1
    next: int = 0  # first byte of the file that has not been requested
    asked: deque[Want] = field(default_factory=deque)
    tries: int = 0

    @property
    def file(self) -> File:
        return self.contents.files[self.number]

    @property
    def path(self) -> Path:
        return self.folder / self.file.name

    def close(self) -> None:
        if self.descriptor >= 0:
            os.close(self.descriptor)
        self.descriptor = -1


class _Unwanted(Exception):
    """Error that the lab declines the episode; `again_s`: pause before the station may offer it again [s]."""

    def __init__(self, reason: str, again_s: float) -> None:
        super().__init__(reason)
        self.again_s = again_s


class Shelf:
    """Disk storage for the episodes that one station sends. One thread uses it."""

    def __init__(
        self,
        data: Path,
        station: str,
        owner: Owner,
        reserve: int = RESERVE,
        read_back: ReadBack = _unread,
    ) -> None:
        self.station = station
        self._data, self._owner, self._reserve, self._read_back = data, owner, reserve, read_back
        self._episodes = data / "episodes"
        self._root = self._episodes / ARRIVING / station
        self._begun: _Begun | None = None

    def handle(self, message: Message, part: bytes) -> Iterator[Message]:
        """Handle a message of the station; yield the answers."""
        episode = getattr(message, "episode", "")
        try:
            if isinstance(message, Offer):
                yield from self._offered(episode, part)
            elif isinstance(message, Piece):
                yield from self._piece(message, part)
            elif isinstance(message, Labels):
                yield self._labelled(episode, part)
        except _Unwanted as unwanted:
            yield self._declined(episode, str(unwanted), unwanted.again_s)
        except CodecError as error:
            yield self._declined(episode, f"the list of its files cannot be used: {error}", _NEVER_S)
        except RecordingError as error:
            yield self._declined(episode, str(error), _LATER_S)
        except OSError as error:
            yield self._declined(episode, str(disk_error("writing", self._root, error)), _SOON_S)

    def drop(self) -> None:
        """Stop receiving the current episode; its files stay, so that it can be continued later."""
        if self._begun is not None:
            self._begun.close()
        self._begun = None

    # --- an episode ----------------------------------------------------------------------------------------------

    def _offered(self, episode: str, sent: bytes) -> Iterator[Message]:
        self.drop()
        if not is_episode(episode):
            raise _Unwanted(f"{episode!r:.80} is no episode: expected its uuid", _NEVER_S)
        contents = unpacked(sent)
        self._require_own(episode)
        if (self._episodes / episode).exists():
            yield self._answer_existing(episode, contents)
            return
        folder = self._staging(episode, contents)
        missing = contents.size - sum(_size(folder / file.name) for file in contents.files)
        self._require_room(missing)
        self._begun = _Begun(episode, contents, folder)
        _temporary_path(self._root, episode, "declined").unlink(missing_ok=True)
        yield from self._go_on(self._begun)

    def _piece(self, piece: Piece, data: bytes) -> Iterator[Message]:
        begun = self._begun
        if begun is None or begun.episode != piece.episode:
            return  # sent before the station learned that the episode is declined
        want = begun.asked.popleft() if begun.asked else None
        if want is None or (piece.file, piece.offset) != (want.file, want.offset):
            self.drop()
            raise _Unwanted("what came is not what was asked for", _SOON_S)
        if len(data) != want.count:
            self.drop()
            raise _Unwanted(
                f"{want.file} had {want.count} bytes at {want.offset} when it was offered, and has {len(data)} now",
                _SOON_S,
            )
        try:
            self._require_room(len(data))
            _write_at(begun.descriptor, data, piece.offset)
        except (_Unwanted, OSError):
            self.drop()
            raise
        yield from self._go_on(begun)

    def _go_on(self, begun: _Begun) -> Iterator[Message]:
        """Request the missing bytes of the current file; if there are none, verify it and continue with the next."""
        while begun.number < len(begun.contents.files):
            file = begun.file
            if begun.descriptor < 0:
                begun.descriptor, begun.next = _opened(begun.path, file.size)
            while begun.next < file.size and len(begun.asked) < _WINDOW:
                count = min(PIECE, file.size - begun.next)
                want = Want(begun.episode, file.name, begun.next, count)
                begun.asked.append(want)
                begun.next += count
                yield want
            if begun.asked:
                return
            self._compare(begun, file)
        yield self._finish(begun)

    def _compare(self, begun: _Begun, file: File) -> None:
        """Verify a file by reading it back from the disk; a file with another digest is requested again.

        It is requested `_MOST_TRIES` times in all.
        """
        os.fsync(begun.descriptor)
        begun.close()
        if _sha256(begun.path) == file.sha256:
            begun.number, begun.tries = begun.number + 1, 0
            return
        begun.path.unlink()
        begun.tries += 1
        log.warning("%s: %s of episode %s is not what its list says", self.station, file.name, begun.episode)
        if begun.tries >= _MOST_TRIES:
            self.drop()
            raise _Unwanted(
                f"{file.name} was sent {_MOST_TRIES} times, and is not what its SHA-256 says", _LATER_S
            )

    def _finish(self, begun: _Begun) -> Message:
        self._begun = None
        folder, target = begun.folder, self._episodes / begun.episode
        self._require_named(begun)
        self._require_own(begun.episode)
        sync_folder(folder)
        try:
            os.rename(folder, target)
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise
            return self._answer_existing(begun.episode, begun.contents)
        sync_folder(self._episodes)
        return self._arrived(begun.episode, begun.contents)

    def _answer_existing(self, episode: str, contents: Contents) -> Message:
        """Return the answer to the offer of an episode that the lab has already: `Arrived` if the contents are equal.

        Raises: _Unwanted, which declines the offer, if they differ; nothing is overwritten.
        """
        existing = self._existing(episode, contents)
        if existing != contents:
            differing = [file.name for file in contents.files if file not in existing.files]
            raise _Unwanted(
                f"the lab has an episode {episode} already, with other content "
                f"({', '.join(differing) or 'more files'}): nothing is overwritten",
                _NEVER_S,
            )
        return self._arrived(episode, contents)

    def _existing(self, episode: str, contents: Contents) -> Contents:
        """Return the files of an episode that the lab has, with those of `contents` that are in its store alone.

        These are read back from there, as the others are read here: the station may remove its copy at the answer.

        Raises: _Unwanted, which declines the offer, if the store does not give them.
        """
        folder = self._episodes / episode
        here, stored = contents_of(folder), stored_files(folder)
        names = {file.name for file in here.files}
        away = [
            file for file in contents.files if file.name not in names and stored.get(file.name) == file.sha256
        ]
        for file in away:
            try:
                self._read_back(file.sha256)
            except OSError as error:
                raise _Unwanted(
                    f"{file.name} is in the lab's store, which does not give it: {error}", _LATER_S
                ) from None
        return Contents(tuple(sorted((*here.files, *away), key=lambda file: file.name)))

    def _arrived(self, episode: str, contents: Contents) -> Message:
        self._request_reconcile(episode)
        self._forget(episode)
        log.info("%s: episode %s has arrived, %d bytes", self.station, episode, contents.size)
        return Arrived(episode, contents.digest)

    # --- requirements --------------------------------------------------------------------------------------------

    def _require_own(self, episode: str) -> None:
        try:
            owner = self._owner(episode)
        except OSError as error:
            raise _Unwanted(f"the lab cannot say now whose episode that is: {error}", _SOON_S) from None
        if owner not in ("", self.station):
            raise _Unwanted(f"episode {episode} is of another station of this lab", _NEVER_S)

    def _require_named(self, begun: _Begun) -> None:
        """Check that the manifest names this episode and station; otherwise delete the files and decline."""
        try:
            manifest = read_json(begun.folder / MANIFEST)
        except RecordingError as error:
            manifest, reason = {}, str(error)
        else:
            reason = (
                f"it is of episode {manifest.get('uuid')!r:.80} and station {manifest.get('station')!r:.80}"
            )
        if (manifest.get("uuid"), manifest.get("station")) != (begun.episode, self.station):
            self._forget(begun.episode)
            raise _Unwanted(f"its {MANIFEST} does not say that it is this station's: {reason}", _NEVER_S)

    def _require_room(self, size: int) -> None:
        free = shutil.disk_usage(self._episodes).free
        if free - size < self._reserve:
            raise _Unwanted(
                f"the lab's disk has too little room for it: {free / 1e9:.1f} GB free, {size / 1e9:.1f} wanted, "
                f"{self._reserve / 1e9:.1f} are kept free",
                _SOON_S,
            )

    # --- files ---------------------------------------------------------------------------------------------------

    def _staging(self, episode: str, contents: Contents) -> Path:
        """Return the folder of the partial episode, without files that are not in its list.

        The oldest partial episodes beyond `_MOST_BEGUN` are deleted.
        """
        folder, contents_file = self._root / episode, _temporary_path(self._root, episode, "json")
        sent = contents.packed()
        if (
            not contents_file.exists() or contents_file.read_bytes() != sent
        ):  # different content was offered under this uuid before
            self._forget(episode)
        folder.mkdir(parents=True, exist_ok=True)
        for path in folder.iterdir():
            if path.name not in {file.name for file in contents.files}:
                path.unlink()
        write_atomic(contents_file, sent)
        begun = sorted((path for path in self._root.iterdir() if path.is_dir()), key=_changed)
        for path in [path for path in begun if path != folder][: max(0, len(begun) - _MOST_BEGUN)]:
            self._forget(path.name)
        return folder

    def _forget(self, episode: str) -> None:
        """Delete the partial files of an episode, its list, and the record that it was declined."""
        shutil.rmtree(self._root / episode, ignore_errors=True)
        for kind in ("json", "declined"):
            _temporary_path(self._root, episode, kind).unlink(missing_ok=True)

    def _declined(self, episode: str, reason: str, again_s: float) -> Declined:
        log.warning("%s: episode %.40r is not taken: %s", self.station, episode, reason)
        if is_episode(episode):
            with suppress(OSError, RecordingError):  # full disk: the station is answered all the same
                self._root.mkdir(parents=True, exist_ok=True)
                write_atomic(_temporary_path(self._root, episode, "declined"), reason.encode())
                for path in sorted(self._root.glob("*.declined"), key=_changed)[:-_MOST_DECLINED]:
                    path.unlink()
        return Declined(episode, reason[:500], again_s)

    def _request_reconcile(self, episode: str) -> None:
        """Mark the episode as arrived, by a file in the folder ARRIVALS.

        A worker that finds the mark writes the episode's rows to the database.
        """
        folder = self._data / ARRIVALS
        folder.mkdir(parents=True, exist_ok=True)
        write_atomic(folder / episode, self.station.encode())

    # --- labels --------------------------------------------------------------------------------------------------

    def _labelled(self, episode: str, lines: bytes) -> Message:
        """Store the label lines of an episode if they extend the lines that the lab has; return the confirmation.

        Otherwise nothing is changed, and _Unwanted is raised, which declines the lines.
        """
        if not is_episode(episode) or len(lines) > LARGEST_LABELS:
            raise _Unwanted(
                f"{len(lines)} bytes of labels; allowed: {LARGEST_LABELS}, of an episode", _NEVER_S
            )
        manifest = read_json(self._episodes / episode / MANIFEST)
        if manifest.get("station") != self.station:
            raise _Unwanted(f"episode {episode} is of another station of this lab", _NEVER_S)
        path = self._data / LABELS / f"{episode}.jsonl"
        existing = path.read_bytes() if path.exists() else b""
        if not lines.startswith(existing):
            raise _Unwanted("the lab has other labels of it: nothing is overwritten", _NEVER_S)
        if lines != existing:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomic(path, lines)
            self._request_reconcile(episode)
        return Arrived(episode, _digest(lines))


def _digest(data: bytes) -> str:

    return hashlib.sha256(data).hexdigest()


def _sha256(path: Path) -> str:

    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _opened(path: Path, size: int) -> tuple[int, int]:
    """Open a file for writing; return descriptor and present size. A file longer than `size` is emptied first."""
    if path.is_symlink() or _size(path) > size:
        path.unlink()
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644)
    return descriptor, os.fstat(descriptor).st_size


def _write_at(descriptor: int, data: bytes, offset: int) -> None:
    view = memoryview(data)
    while view:
        written = os.pwrite(descriptor, view, offset)
        view, offset = view[written:], offset + written


def _temporary_path(root: Path, episode: str, kind: str) -> Path:
    return root / f"{episode}.{kind}"


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0


def _changed(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0
