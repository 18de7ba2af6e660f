"""Folder of a station's sockets, which only its account can enter, and files with the sockets' paths.

An account that can enter the folder can command the station. So another account must not own the folder or have any
permission for it.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import pwd
import secrets
import socket
import stat
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from runtime.core.errors import TransportError

log = logging.getLogger(__name__)
RETRY_S = 1.0
LOOK_S = 0.2  # [s] between two checks that a socket, or its file, still exists
_IN_SESSION = "eva-web"
LONGEST = 107  # [bytes] of the path of a Unix socket
_LONGEST_NAME = len("/commands-01234567")
_OTHERS = stat.S_IRWXG | stat.S_IRWXO
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


def socket_folder(station_dir: Path) -> Path:
    """Return the folder of the station's sockets, created if missing; each station of a data folder has its own.

    It is below $XDG_RUNTIME_DIR, else in ~/.cache.

    Raises:
        TransportError: another account owns it or has permissions for it.
    """
    return _usable(next(_folders(station_dir)), station_dir)


def _folders(station_dir: Path) -> Iterator[Path]:
    """Yield the possible folders for the sockets, best first.

    A starting station uses the first; a running one uses a later one if the first has become unusable.
    """
    name = hashlib.sha256(os.fsencode(station_dir.resolve())).hexdigest()[:16]
    runtime_dir = os.environ.get("XDG_RUNTIME_DIR", "")
    if runtime_dir and not _missing(Path(runtime_dir)):
        yield Path(runtime_dir) / _IN_SESSION / name
    yield Path.home() / ".cache" / "eva-web-run" / name
    yield station_dir / "sockets"


def _missing(folder: Path) -> bool:
    try:
        return not folder.is_dir()
    except OSError:  # it may exist without being accessible
        return False


def _usable(folder: Path, station_dir: Path) -> Path:
    if (length := len(os.fsencode(folder)) + _LONGEST_NAME) > LONGEST:
        raise TransportError(
            f"the paths of the sockets in {folder} have up to {length} bytes; allowed: {LONGEST}; set XDG_RUNTIME_DIR "
            "to a folder of this account's own with a shorter name, mode 0700"
        )
    if folder.parent.name == _IN_SESSION:
        _require_owned(folder.parents[1], _OTHERS_WRITE)
    if folder.parent != station_dir:
        _ensure_folder(folder.parent)
    return _ensure_folder(folder)


def _ensure_folder(folder: Path) -> Path:
    try:
        folder.mkdir(0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise TransportError(
            f"the folder of the sockets, {folder}, cannot be made ({error.strerror}): set XDG_RUNTIME_DIR to a "
            "folder of this account's own with mode 0700"
        ) from None
    return _require_owned(folder, _OTHERS)


def _require_owned(folder: Path, forbidden: int) -> Path:
    """Return `folder` if it belongs to this account without the permissions `forbidden`; else raise TransportError."""
    try:
        status = folder.lstat()
    except OSError as error:
        raise TransportError(
            f"{folder} is to hold the sockets of stations, and cannot be looked at: {error.strerror}"
        ) from None
    if not stat.S_ISDIR(status.st_mode):
        raise TransportError(f"{folder} is to hold the sockets of stations: it must be a folder, and no link")
    if status.st_uid != os.geteuid():
        raise TransportError(
            f"{folder} is to hold the sockets of stations, and belongs to {account_name(status.st_uid)}: "
            f"who has it can command them; allowed: a folder of {account_name(os.geteuid())}, in XDG_RUNTIME_DIR "
            "or at home"
        )
    if status.st_mode & forbidden:
        raise TransportError(
            f"{folder} is to hold the sockets of stations, and has the mode {stat.S_IMODE(status.st_mode):04o}: "
            "others could command them; allowed: 0700"
        )
    return folder


def account_name(uid: int) -> str:
    """Return the name of an account, `uid N` if it has none."""
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return f"uid {uid}"


def new_socket_path(station_dir: Path, name: str) -> Path:
    """Return a new path for the socket `name`, and remove sockets of that name that dead processes left.

    Paths are unique, so a process that ends never removes the socket of its successor. If the first folder is unusable,
    the next one is used and the reason is logged: a running station must not be lost because of a folder.

    Raises:
        TransportError: no folder is usable.
    """
    refusal: TransportError | None = None
    for place in _folders(station_dir):
        try:
            folder = _usable(place, station_dir)
        except TransportError as error:
            refusal = refusal or error
            continue
        if refusal is not None:
            log.error("the socket of %s is in %s: %s", name, folder, refusal)
        for old in folder.glob(f"{name}-*"):
            old.unlink(missing_ok=True)
        return folder / f"{name}-{secrets.token_hex(4)}"
    assert refusal is not None
    raise refusal


def file_identity(path: Path) -> tuple[int, int]:
    """Return device and inode of a file.

    (0, 0) if it is gone, unreachable, or in a folder that other accounts can enter.
    """
    try:
        _require_owned(path.parent, _OTHERS)
        status = path.lstat()
    except (TransportError, OSError):
        return 0, 0
    return status.st_dev, status.st_ino


def connection_problem(endpoint: str) -> str:
    """Return the reason why clients cannot connect to a socket, and advice; "" if a process listens there."""
    path = Path(endpoint.removeprefix("ipc://"))
    mend = "where the station runs, it listens elsewhere within a second: press again; else start it again"
    probe = socket.socket(socket.AF_UNIX)
    try:
        probe.setblocking(False)
        probe.connect(str(path))
    except BlockingIOError:  # its backlog is full
        return ""
    except PermissionError:
        return f"{path} cannot be reached: give {path.parent} back to {account_name(os.geteuid())}, mode 0700; {mend}"
    except OSError as error:
        return f"{path}: no process listens there ({error.strerror}): {mend}"
    finally:
        probe.close()
    return ""


class Endpoints:
    """Addresses of a station's sockets: one small file per process in the station's folder."""

    def __init__(self, station_dir: Path) -> None:
        self._station_dir = station_dir
        self._folder = station_dir / "endpoints"
        self._wanted: dict[str, str] = {}  # by process: content that is not on disk yet
        self._said: dict[str, set[str]] = {}  # by process: keys that were written
        self._lock = threading.Lock()
        self._looked = time.monotonic()

    def is_missing(self, process: str) -> bool:
        """Return True if this process's file is gone or unreadable; it is checked at most every LOOK_S seconds.

        A file that a successor wrote counts as present and is not replaced.
        """
        if time.monotonic() - self._looked < LOOK_S:
            return False
        self._looked = time.monotonic()
        if process in self._wanted:
            return False
        try:
            return not self._said[process] <= self._content(process).keys()
        except (OSError, ValueError, RecursionError):  # clients cannot read it either
            return True

    def write(self, process: str, endpoints: Mapping[str, str]) -> bool:
        """Write this process's endpoints, which atomically replaces those of its predecessor; return True if done.

        If the file cannot be written, an error is logged, and a thread retries every RETRY_S seconds until it succeeds.
        The process can go on meanwhile.
        """
        with self._lock:
            retried = bool(self._wanted)
            self._said[process] = set(endpoints)
            self._wanted[process] = json.dumps({**endpoints, "pid": os.getpid()})
            failure = self._write_now()
        if failure is not None:
            log.error(
                "clients cannot find the process %s until the disk takes its file: %s", process, failure
            )
            if not retried:
                threading.Thread(target=self._retry, name="endpoints", daemon=True).start()
        return failure is None

    def withdraw(self, process: str) -> None:
        """Remove this process's file, and cancel a pending write, so that clients no longer find it."""
        with self._lock:
            self._wanted.pop(process, None)
            self._said.pop(process, None)
            try:
                self._file(process).unlink(missing_ok=True)
            except OSError as error:  # for example a full disk; the process must end all the same
                log.error("clients still find the process %s: %s", process, error)

    def _retry(self) -> None:
        while True:
            time.sleep(RETRY_S)
            with self._lock:
                if self._write_now() is None:
                    return

    def _write_now(self) -> OSError | None:
        """Write pending files; return the error if some could not be written, else None."""
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            for process in list(self._wanted):
                new = self._folder / f".{process}.{os.getpid()}"
                new.write_text(self._wanted[process], "utf-8")
                new.replace(self._file(process))
                del self._wanted[process]
        except OSError as error:
            return error
        return None

    def read(self, process: str) -> dict[str, Any]:
        """Return the endpoints of `process`.

        Raises:
            TransportError: the process has written none; the message lists the known stations.
        """
        try:
            return self._content(process)
        except (OSError, ValueError, RecursionError) as error:
            path, station = self._file(process), self._folder.parent
            stations = ", ".join(sorted(p.parent.name for p in station.parent.glob("*/endpoints"))) or "none"
            raise TransportError(
                f"station {station.name!r} is not running here ({path}: {error.__class__.__name__}); "
                f"start it with python -m runtime DEPLOYMENT, or name another data folder (looked in "
                f"{station.parent}, running or once run: {stations})"
            ) from None

    def address(self, process: str, socket: str) -> str:
        """Return the endpoint of one socket of `process`, "" if there is none.

        Unlike `read` it lists no other stations, so that many absent stations can be polled.
        """
        try:
            return str(self._content(process)[socket])
        except (OSError, ValueError, RecursionError, KeyError):
            return ""

    def served(self, process: str) -> bool:
        """Return True if the file of `process` exists and the process that wrote it is alive."""
        try:
            os.kill(int(self._content(process)["pid"]), 0)
        except PermissionError:  # it exists, under another account
            return True
        except (OSError, ValueError, KeyError, TypeError, RecursionError, OverflowError):
            return False
        return True

    def _content(self, process: str) -> dict[str, Any]:
        content = json.loads(self._file(process).read_text("utf-8"))
        if not isinstance(content, dict):
            raise ValueError(f"{self._file(process)} holds a {type(content).__name__}; allowed: an object")
        return content

    def is_listening(self, name: str) -> bool:
        """Return True if a process listens at a socket called `name`; the files of endpoints are not consulted.

        The result is also False if it cannot be determined.
        """
        for folder in _folders(self._station_dir):
            with suppress(OSError):  # missing or not accessible
                if any(not connection_problem(f"ipc://{path}") for path in folder.glob(f"{name}-*")):
                    return True
        return False

    @property
    def owner(self) -> int | None:
        """The account of the station; None if unknown."""
        try:
            return self._folder.stat().st_uid
        except OSError:
            return None

    def _file(self, process: str) -> Path:
        return self._folder / f"{process}.json"

    def prepare(self) -> None:
        """Clear the endpoints for a starting station.

        Raises:
            TransportError: the folder of sockets belongs to another account, or other accounts have permissions for it.
        """
        socket_folder(self._station_dir)
        self.clear()

    def clear(self) -> None:
        """Remove the files and sockets of earlier station processes, and cancel pending writes."""
        with self._lock:
            self._wanted.clear()
        for path in self._folder.glob("*.json"):
            path.unlink(missing_ok=True)
        for folder in _folders(self._station_dir):
            with suppress(OSError):  # missing or not accessible
                for path in folder.iterdir():
                    path.unlink(missing_ok=True)
                folder.rmdir()
