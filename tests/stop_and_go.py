"""A machine that stands still: `python -m tests.stop_and_go SECONDS EVERY -- COMMAND ...`.

Runs the command and stops all of its processes for so long, every so often, as a virtual machine does that is not run;
its clock goes on. Exit code: the command's.
"""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import time

import psutil


def everybody(root: psutil.Process) -> list[psutil.Process]:
    """The process and what it started, the oldest first."""
    with contextlib.suppress(psutil.NoSuchProcess):
        return [root, *root.children(recursive=True)]
    return []


def main() -> int:
    """Until the command ends."""
    seconds, every, command = float(sys.argv[1]), float(sys.argv[2]), sys.argv[4:]
    child = subprocess.Popen(command)
    root = psutil.Process(child.pid)
    while child.poll() is None:
        with contextlib.suppress(subprocess.TimeoutExpired):
            child.wait(every)
            break
        stopped = everybody(root)
        for number, pause in ((signal.SIGSTOP, seconds), (signal.SIGCONT, 0.0)):
            for process in stopped:
                with contextlib.suppress(psutil.NoSuchProcess):
                    process.send_signal(number)
            time.sleep(pause)
    return child.wait()


if __name__ == "__main__":
    sys.exit(main())
