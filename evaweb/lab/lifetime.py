"""Resources of which a lab has one: the lock on its data folder, the port, the signals that end it."""

from __future__ import annotations

import fcntl
import os
import signal
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from evaweb.lab.processes import LabError


class Ended(Exception):
    """The lab was asked to end."""


@contextmanager
def only_one(data_dir: Path) -> Iterator[None]:
    """Hold the data folder; LabError names the process that holds it already."""
    with (data_dir / "lab.lock").open("a+", encoding="utf-8") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            lock.seek(0)
            raise LabError(
                f"a lab is already running on {data_dir} (process {lock.read().strip() or '?'}): "
                "end it first, or name another folder with EVA_DATA_DIR"
            ) from None
        lock.truncate(0)
        os.write(lock.fileno(), str(os.getpid()).encode())
        yield


def require_free(host: str, port: int, option: str = "--port") -> None:
    """LabError where nothing can listen there; whatever holds the port is left alone."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            raise LabError(
                f"cannot listen on {host}:{port}: {error.strerror}; name another port with {option}"
            ) from None


def end_on_signals() -> None:
    """SIGINT and SIGTERM raise Ended in the main thread, once; a second one changes nothing."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _end)


def _end(number: int, frame: FrameType | None) -> None:
    for each in (signal.SIGINT, signal.SIGTERM):
        signal.signal(each, signal.SIG_IGN)
    raise Ended
