"""A terminal that reads on no more (`... | head -1`), or a disk that is full (`... > FILE`), ends a command without a
traceback; here, below all programs.
"""

from __future__ import annotations

import io
import os
import select
import sys
from collections.abc import Callable, Sequence
from functools import wraps
from typing import ParamSpec, TextIO

EXIT_BROKEN_PIPE = 141  # exit code, that of a shell for an end by SIGPIPE
EXIT_WRITE_ERROR = 74  # exit code, EX_IOERR of sysexits.h

_STREAMS = (0, 1, 2)  # standard input, output and error

Given = ParamSpec("Given")


def exit_on_broken_pipe(main: Callable[Given, int]) -> Callable[Given, int]:
    """`main`, with the exit code 141 where standard output or error is a pipe that nobody reads any more.

    Where the disk does not take standard output it is 74, and standard error says so. An OSError of anything else
    stays one. A stream that was closed (`>&-`) goes nowhere, and the code is that of the command.
    """

    @wraps(main)
    def run(*given: Given.args, **named: Given.kwargs) -> int:
        _open_closed()
        try:
            try:
                code = main(*given, **named)
            except SystemExit:  # of argparse, which has printed its help
                _flush()
                raise
            _flush()  # here, and not when the process ends
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
    """Let closed streams go nowhere, here and in children: else the next file that is opened takes their number."""
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
    """True if standard output raised it: what could not be written waits in it, and goes nowhere now."""
    try:
        _flush()
    except OSError as again:
        if again.errno == error.errno:
            _to_nowhere([_descriptor(sys.stdout)])
            return True
    return False


def _silenced() -> bool:
    """True if one of our streams has no reader; what waits to be written there goes nowhere from now on."""
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
    except (AttributeError, io.UnsupportedOperation):  # there is none, or it is no file
        return -1


def _unread(number: int) -> bool:
    poll = select.poll()
    poll.register(number, 0)
    return any(told & select.POLLERR for _, told in poll.poll(0))
