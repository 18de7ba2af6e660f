"""Sockets of a station: in a folder that this account alone can enter, and in files that say where they are.

An account that can enter the folder can speak to the station, so that no other may have made it, or
have a right in it.
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
LOOK_S = 0.2  # between two looks whether a socket, or its file, is still there
_IN_SESSION = "eva-web"
LONGEST = 107  # bytes of the path of a Unix socket
_LONGEST_NAME = len("/commands-01234567")
_OTHERS = stat.S_IRWXG | stat.S_IRWXO
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


def socket_folder(station_dir: Path) -> Path:
    """The folder of the station's sockets, made where it is missing; one per data folder and station.

    Below $XDG_RUNTIME_DIR, else in ~/.cache. Raises TransportError where another account has a part in it.
    """
    return _usable(next(_folders(station_dir)), station_dir)


def _folders(station_dir: Path) -> Iterator[Path]:
    """Folders for the sockets, best first; a station that starts takes the first, one that runs any."""
    name = hashlib.sha256(os.fsencode(station_dir.resolve())).hexdigest()[:16]
    given = os.environ.get("XDG_RUNTIME_DIR", "")
    if given and not _missing(Path(given)):
        yield Path(given) / _IN_SESSION / name
    yield Path.home() / ".cache" / "eva-web-run" / name
    yield station_dir / "sockets"


def _missing(folder: Path) -> bool:
    try:
        return not folder.is_dir()
    except OSError:  # it may be there, and cannot be looked at
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
    """`folder`, which is this account's and gives none of the rights `forbidden`; else TransportError."""
    try:
        found = folder.lstat()
    except OSError as error:
        raise TransportError(
            f"{folder} is to hold the sockets of stations, and cannot be looked at: {error.strerror}"
        ) from None
    if not stat.S_ISDIR(found.st_mode):
        raise TransportError(f"{folder} is to hold the sockets of stations: it must be a folder, and no link")
    if found.st_uid != os.geteuid():
        raise TransportError(
            f"{folder} is to hold the sockets of stations, and belongs to {account_name(found.st_uid)}: who has it can "
            f"command them; allowed: a folder of {account_name(os.geteuid())}, in XDG_RUNTIME_DIR or at home"
        )
    if found.st_mode & forbidden:
        raise TransportError(
            f"{folder} is to hold the sockets of stations, and has the mode {stat.S_IMODE(found.st_mode):04o}: "
            "others could command them; allowed: 0700"
        )
    return folder


def account_name(uid: int) -> str:
    """The name of the account with that number; `uid N` where it has none."""
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return f"uid {uid}"


def new_socket_path(station_dir: Path, name: str) -> Path:
    """Path for the socket `name`; what dead processes left of that name is removed.

    No two have the same path, so that an end never removes the socket of a successor. Where the first folder is of no
    use, it is the next one, and the log says so: a station that runs is not lost for a folder. Raises TransportError.
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
    """Which file that is; (0, 0) where it is gone, cannot be reached, or lies where others have a part."""
    try:
        _require_owned(path.parent, _OTHERS)
        found = path.lstat()
    except (TransportError, OSError):
        return 0, 0
    return found.st_dev, found.st_ino


def connection_problem(endpoint: str) -> str:
    """Why nobody can connect to a socket, and what to do; "" where somebody listens there."""
    path = Path(endpoint.removeprefix("ipc://"))
    mend = "where the station runs, it listens elsewhere within a second: press again; else start it again"
    probe = socket.socket(socket.AF_UNIX)
    try:
        probe.setblocking(False)
        probe.connect(str(path))
    except BlockingIOError:  # more wait there than it takes at once
        return ""
    except PermissionError:
        return f"{path} cannot be reached: give {path.parent} back to {account_name(os.geteuid())}, mode 0700; {mend}"
    except OSError as error:
        return f"nobody listens at {path} ({error.strerror}): {mend}"
    finally:
        probe.close()
    return ""


class Endpoints:
    """Places of a station's sockets: one small file per process in the station's folder."""

    def __init__(self, station_dir: Path) -> None:
        self._station_dir = station_dir
        self._folder = station_dir / "endpoints"
        self._wanted: dict[str, str] = {}  # by process, what is not on disk yet
        self._said: dict[str, set[str]] = {}  # by process, the keys of what was written
        self._lock = threading.Lock()
        self._looked = time.monotonic()

    def is_missing(self, process: str) -> bool:
        """True if the file that this process wrote is gone, or says nothing; looks five times a second.

        What a successor wrote is left as it is.
        """
        if time.monotonic() - self._looked < LOOK_S:
            return False
        self._looked = time.monotonic()
        if process in self._wanted:
            return False
        try:
            return not self._said[process] <= self._content(process).keys()
        except (OSError, ValueError, RecursionError):  # nor can anybody read it
            return True

    def write(self, process: str, endpoints: Mapping[str, str]) -> bool:
        """Leave this process's endpoints, replacing those of its predecessor at once.

        Where the disk refuses, a line in the log says so, and a thread tries again once a second until it does
        not: the work of the process does not depend on it. Returns whether they are there.
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
        """Nobody finds this process any more; what it wrote, or was about to write, is gone."""
        with self._lock:
            self._wanted.pop(process, None)
            self._said.pop(process, None)
            try:
                self._file(process).unlink(missing_ok=True)
            except OSError as error:  # of a disk that takes no more: what listens there ends for no file
                log.error("clients still find the process %s: %s", process, error)

    def _retry(self) -> None:
        while True:
            time.sleep(RETRY_S)
            with self._lock:
                if self._write_now() is None:
                    return

    def _write_now(self) -> OSError | None:
        """Write what is wanted; the error that kept some of it from the disk."""
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
        """The endpoints of `process`; raises TransportError where the station has none."""
        path = self._file(process)
        try:
            return self._content(process)
        except (OSError, ValueError, RecursionError) as error:
            station = self._folder.parent
            known = ", ".join(sorted(p.parent.name for p in station.parent.glob("*/endpoints"))) or "none"
            raise TransportError(
                f"station {station.name!r} is not running here ({path}: {error.__class__.__name__}); "
                f"start it with python -m runtime DEPLOYMENT, or name another data folder (looked in "
                f"{station.parent}, running or once run: {known})"
            ) from None

    def served(self, process: str) -> bool:
        """True if `process` has said where it listens, and lives."""
        try:
            os.kill(int(self._content(process)["pid"]), 0)
        except PermissionError:  # of another account: it is there
            return True
        except (OSError, ValueError, KeyError, TypeError, RecursionError, OverflowError):
            return False
        return True

    def _content(self, process: str) -> dict[str, Any]:
        found = json.loads(self._file(process).read_text("utf-8"))
        if not isinstance(found, dict):
            raise ValueError(f"{self._file(process)} holds a {type(found).__name__}; allowed: an object")
        return found

    def is_listening(self, name: str) -> bool:
        """True if a process listens at a socket of that name, whatever the files say; False if unknown."""
        for folder in _folders(self._station_dir):
            with suppress(OSError):  # it is not there, or nobody can get at it
                if any(not connection_problem(f"ipc://{path}") for path in folder.glob(f"{name}-*")):
                    return True
        return False

    @property
    def owner(self) -> int | None:
        """The account whose station this is; None where nobody can say."""
        try:
            return self._folder.stat().st_uid
        except OSError:
            return None

    def _file(self, process: str) -> Path:
        return self._folder / f"{process}.json"

    def prepare(self) -> None:
        """As `clear`, of a station that starts; TransportError where its folder of sockets is not its own."""
        socket_folder(self._station_dir)
        self.clear()

    def clear(self) -> None:
        """Remove what a former family left, its sockets too, and forget what is not written yet."""
        with self._lock:
            self._wanted.clear()
        for path in self._folder.glob("*.json"):
            path.unlink(missing_ok=True)
        for folder in _folders(self._station_dir):
            with suppress(OSError):  # it is not there, or nobody can get at it
                for path in folder.iterdir():
                    path.unlink(missing_ok=True)
                folder.rmdir()
