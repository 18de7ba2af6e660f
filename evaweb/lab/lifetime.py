"""Resources of which a lab has one: the lock on its data folder, the port, the signals that end it."""

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
    """The lab was asked to end; nothing that catches errors on the way holds it up."""


@contextmanager
def hold_data_folder(data_dir: Path) -> Iterator[None]:
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
    """SIGINT, SIGTERM and the end of the terminal raise Ended in the main thread, once; a second one changes nothing.

    One that was ignored when we were started, as by nohup, stays so.
    """
    for number in _ENDS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _end)


def _end(number: int, frame: FrameType | None) -> None:
    for each in _ENDS:
        signal.signal(each, signal.SIG_IGN)
    if number == signal.SIGHUP:  # what is still said has no terminal to go to
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for descriptor in (1, 2):
            if stat.S_ISCHR(os.fstat(descriptor).st_mode):  # of a terminal that is gone isatty says no
                os.dup2(nowhere, descriptor)
        os.close(nowhere)
    raise StopRequested
