"""A real ROS master for tests, on a port of its own: Debian's roscore, or rosmaster where that is all there is."""

from __future__ import annotations

import contextlib
import functools
import os
import shutil
import signal
import socket
import subprocess
import xmlrpc.client
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.processes import PATIENCE_S, eventually

PYTHON = "/usr/bin/python3"
_IMPORTS = "import rospy, rosmaster, sensor_msgs.msg, geometry_msgs.msg"


@functools.cache
def absent() -> str:
    """Why no ROS 1 can be tested here; "" where it can."""
    if not Path(PYTHON).exists():
        return f"{PYTHON}, whose rospy is tested, is not there"
    done = subprocess.run([PYTHON, "-c", _IMPORTS], capture_output=True, text=True, check=False)
    if done.returncode or shutil.which("rosmaster") is None:
        said = (done.stderr.splitlines() or ["no rosmaster"])[-1]
        return f"Debian's python3-rospy, python3-rosmaster and python3-sensor-msgs are not installed ({said})"
    return ""


needs_ros1 = pytest.mark.skipif(bool(absent()), reason=absent() or "ROS 1 is here")


class RosMaster:
    """A master at `uri`; `start` again after `kill` is another one at the same place."""

    def __init__(self, folder: Path, whole: bool = False) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port: int = probe.getsockname()[1]
        self.uri = f"http://127.0.0.1:{self.port}"
        self.environment = {
            **{name: value for name, value in os.environ.items() if not name.startswith("ROS_")},
            "ROS_MASTER_URI": self.uri,
            "ROS_IP": "127.0.0.1",
            "ROS_HOME": str(folder),
        }
        self._line = ["roscore"] if whole and shutil.which("roscore") else ["rosmaster", "--core"]
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start it, and wait until it answers."""
        self._process = subprocess.Popen(
            [*self._line, "-p", str(self.port)],
            env=self.environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            start_new_session=True,
        )
        eventually(self._pid, "a ROS master", 3 * PATIENCE_S)

    def kill(self) -> None:
        """The master is gone without a word; what roscore started beside it ends with it."""
        pid = self._pid()
        assert self._process is not None
        if pid:
            os.kill(pid, signal.SIGKILL)
        self._process.terminate()
        self._process.wait(PATIENCE_S)
        self._process = None

    def close(self) -> None:
        if self._process is not None:
            self.kill()

    def _pid(self) -> int:
        """The master's process; 0 where it does not answer."""
        with contextlib.suppress(OSError), xmlrpc.client.ServerProxy(self.uri) as master:
            answer = master.getPid("/test")
            assert isinstance(answer, list)
            return int(str(answer[2]))
        return 0


@contextlib.contextmanager
def master(folder: Path, whole: bool = False) -> Iterator[RosMaster]:
    """A running one; `whole` is roscore where there is one."""
    made = RosMaster(folder, whole)
    made.start()
    with contextlib.closing(made):
        yield made
