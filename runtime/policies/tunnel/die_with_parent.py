"""Launcher of a program that ends with its parent process, however the parent ends.

Run by its path: `die_with_parent.py PARENT PROGRAM ARGUMENTS...`. It imports only the standard library, so that it
starts the program at once.
"""

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1


def main() -> None:
    """Let the kernel end this process when its parent ends (SIGTERM), and replace it by the program. Never returns."""
    parent, program = int(sys.argv[1]), sys.argv[2:]
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0):
        sys.exit(f"no signal at the station's death: {os.strerror(ctypes.get_errno())}")
    if os.getppid() != parent:
        sys.exit("the station ended before its tunnel began")
    try:
        os.execv(program[0], program)
    except OSError as error:
        sys.exit(f"{program[0]} cannot be started: {error.strerror}")


if __name__ == "__main__":
    main()
