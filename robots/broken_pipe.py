"""Exit of a command without traceback if its output pipe is closed (`... | head -1`) or the disk is full.

It is in this package because all programs may import it.
"""

from __future__ import annotations

import io
import os
import select
import sys
from collections.abc import Callable, Sequence
from functools import wraps
from typing import ParamSpec, TextIO

EXIT_BROKEN_PIPE = 141  # exit code that shells report for an end by SIGPIPE
EXIT_WRITE_ERROR = 74  # exit code EX_IOERR of sysexits.h

_STREAMS = (0, 1, 2)  # standard input, output and error

Given = ParamSpec("Given")


def exit_on_broken_pipe(main: Callable[Given, int]) -> Callable[Given, int]:
    """Return `main`, changed so that a closed pipe at standard output or error gives exit code 141.

    If standard output cannot be written, because the disk is full, the exit code is 74, with a message on standard
    error; any other OSError is raised. Output to a stream that was closed from the start (`>&-`) is discarded, and the
    exit code is the command's own.
    """

    @wraps(main)
    def run(*given: Given.args, **named: Given.kwargs) -> int:
        _open_closed()
        try:
            try:
                code = main(*given, **named)
            except SystemExit:  # argparse exits after printing its help
                _flush()
                raise
            _flush()  # here, because errors at the end of the process could not be handled
        except BrokenPipeError:
            if not _silenced():
                raise
            return EXIT_BROKEN_PIPE
        except OSError as error:
            if not _refused(error):
                raise
            print(f"standard output cannot be written: {error.strerror}", file=sys.stderr)
            return EXIT_WRITE_ERROR
        return code

    return run


def _open_closed() -> None:
    """Connect closed standard streams to /dev/null, here and in children.

    Otherwise the next opened file would get the number of a standard stream.
    """
    number = os.open(os.devnull, os.O_RDWR)
    while number <= _STREAMS[-1]:
        os.set_inheritable(number, True)
        number = os.open(os.devnull, os.O_RDWR)
    os.close(number)
    sys.stdin = sys.stdin or os.fdopen(os.open(os.devnull, os.O_RDONLY))
    sys.stdout = sys.stdout or os.fdopen(os.open(os.devnull, os.O_WRONLY), "w")
    sys.stderr = sys.stderr or os.fdopen(os.open(os.devnull, os.O_WRONLY), "w")


def _flush() -> None:
    print(end="", flush=True)


def _refused(error: OSError) -> bool:
    """Return True if standard output raised the error, after discarding the data that it has not written."""
    try:
        _flush()
    except OSError as again:
        if again.errno == error.errno:
            _to_nowhere([_descriptor(sys.stdout)])
            return True
    return False


def _silenced() -> bool:
    """Return True if the reader of standard output or error is gone, after discarding the data not yet written."""
    unread = [
        number for number in map(_descriptor, (sys.stdout, sys.stderr)) if number >= 0 and _unread(number)
    ]
    _to_nowhere(unread)
    return bool(unread)


def _to_nowhere(descriptors: Sequence[int]) -> None:
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for number in descriptors:
        os.dup2(nowhere, number)
    os.close(nowhere)


def _descriptor(stream: TextIO) -> int:
    try:
        return stream.fileno()
    except (AttributeError, io.UnsupportedOperation):  # no stream, or not a file
        return -1


def _unread(number: int) -> bool:
    poll = select.poll()
    poll.register(number, 0)
    return any(events & select.POLLERR for _, events in poll.poll(0))
