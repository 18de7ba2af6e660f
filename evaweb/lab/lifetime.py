"""Unique resources of a lab: lock of its data folder, ports, and the signals that end it."""

from __future__ import annotations

import fcntl
import os
import signal
import socket
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from evaweb.lab.processes import LabError

_ENDS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class StopRequested(BaseException):
    """Request to end the lab.

    It is a BaseException, so that no error handler catches it on its way to the main program.
    """


@contextmanager
def hold_data_folder(data_dir: Path) -> Iterator[None]:
    """Hold the lock of the data folder during the block.

    Raises:
        LabError: If another lab holds it; it names the process.
    """
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
    """Raise LabError if the port is in use; the program that uses it is left alone."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            raise LabError(
                f"cannot listen on {host}:{port}: {error.strerror}; name another port with {option}"
            ) from None


def end_on_signals() -> None:
    """Raise StopRequested once in the main thread on SIGINT, SIGTERM or the end of the terminal; later signals are
    ignored.

    A signal that was ignored at the start, as with nohup, remains ignored.
    """
    for number in _ENDS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _end)


def _end(number: int, frame: FrameType | None) -> None:
    for end_signal in _ENDS:
        signal.signal(end_signal, signal.SIG_IGN)
    if number == signal.SIGHUP:  # there is no terminal for further output
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for descriptor in (1, 2):
            if stat.S_ISCHR(os.fstat(descriptor).st_mode):  # isatty returns False for a terminal that is gone
                os.dup2(nowhere, descriptor)
        os.close(nowhere)
    raise StopRequested
