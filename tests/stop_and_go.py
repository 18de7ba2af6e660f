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
from collections.abc import Sequence

import psutil


def everybody(root: psutil.Process) -> list[psutil.Process]:
    """The process and what it started, the oldest first."""
    with contextlib.suppress(psutil.NoSuchProcess):
        return [root, *root.children(recursive=True)]
    return []


def _bears_it(process: psutil.Process) -> bool:
    """Not OpenSSH's server: stopped within a handshake, for .1 s even, it ends that connection (5 of 40 tried)."""
    with contextlib.suppress(psutil.Error):
        return not process.name().startswith("sshd")
    return False


def main() -> int:
    """Until the command ends; whoever ends this ends the command too, and leaves nothing stopped."""
    seconds, every, command = float(sys.argv[1]), float(sys.argv[2]), sys.argv[4:]
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda told, frame: sys.exit(128 + told))
    child = subprocess.Popen(command)
    root, stopped = psutil.Process(child.pid), list[psutil.Process]()
    try:
        while child.poll() is None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.wait(every)
                break
            stopped = [
                one for one in everybody(root) if _bears_it(one) and not _stands(one)
            ]  # what a test stopped stays stopped
            _tell(stopped, signal.SIGSTOP)
            time.sleep(seconds)
            _tell(stopped, signal.SIGCONT)
        return child.wait()
    finally:
        _tell(stopped, signal.SIGCONT)
        if child.poll() is None:
            _tell(everybody(root), signal.SIGTERM)
            child.wait()


def _stands(process: psutil.Process) -> bool:
    with contextlib.suppress(psutil.Error):
        return bool(process.status() == psutil.STATUS_STOPPED)
    return True


def _tell(processes: Sequence[psutil.Process], number: int) -> None:
    for process in processes:
        with contextlib.suppress(psutil.Error):  # it has ended, or is somebody else's
            process.send_signal(number)


if __name__ == "__main__":
    sys.exit(main())
