"""A process of its own for rospy, which a process can have but once and which would take its logging and signals.

The child is a program of its own (rospy_node), run by a Python that has rospy. Two sockets lead to it: a stream of
what it hears, each piece behind a head (kind, topic, size), and packets of commands (kind, topic, when it was made),
which are handed over without waiting. Words are JSON. When the sockets close, the child ends.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
import socket
import struct
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from runtime.core.errors import SetupError, TransportError
from runtime.transports.ros.middleware import COMMAND_LIFE_S

MESSAGE, WORD = 1, 2  # as in rospy_node, which imports nothing of ours
_HEAD = struct.Struct("<BxHI")
_COMMAND = struct.Struct("<BxHd")
_PROGRAM = Path(__file__).parent / "rospy_node" / "__main__.py"
_ROOM = 4 << 20  # bytes of a socket's buffer, where the system permits: a picture fits
_START_S = 20.0
_END_S = 2.0
_INSTALL = (
    "install it (Debian: apt-get install python3-rospy python3-sensor-msgs), or name in transport.python the Python of "
    "a ROS 1 installation, with its setup.bash sourced"
)


@dataclass(frozen=True, slots=True)
class RosEnvironment:
    """ROS 1: the Python that has rospy, the master, the address under which nodes reach this machine."""

    python: str
    master: str
    address: str

    @property
    def environment(self) -> dict[str, str]:
        """This process's, with what rospy reads of it."""
        kept = {
            name: value
            for name, value in os.environ.items()
            if name not in ("ROS_HOSTNAME", "ROS_NAMESPACE", "ROS_PYTHON_LOG_CONFIG_FILE")
        }
        return kept | {"ROS_MASTER_URI": self.master, "ROS_IP": self.address}


@functools.cache  # cache: to look starts a process
def require(python: str) -> None:
    """SetupError with what to install where that Python does not exist or has no rospy; a success is remembered."""
    line = [python, str(_PROGRAM), json.dumps({"check": True})]
    try:
        done = subprocess.run(
            line, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=_START_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise SetupError(f"transport.python = {python!r} cannot be run: {error}; {_INSTALL}") from error
    if done.returncode:
        said = (done.stderr.strip().splitlines() or [f"it ended with {done.returncode}"])[-1]
        raise SetupError(f"ROS 1 needs rospy, which {python} (transport.python) lacks: {said}; {_INSTALL}")


class RospyProcess:
    """One life of the child: a node that the master knows, once it is made."""

    def __init__(self, site: RosEnvironment, name: str) -> None:
        """Start it; SetupError without rospy, TransportError where the master does not answer."""
        require(site.python)
        self._telling, telling = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        self._commands, commands = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        telling.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _ROOM)
        options = {
            "name": name,
            "master": site.master,
            "address": site.address,
            "telling": telling.fileno(),
            "commands": commands.fileno(),
            "life": COMMAND_LIFE_S,
        }
        with telling, commands:
            self._process = subprocess.Popen(
                [site.python, str(_PROGRAM), json.dumps(options)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                env=site.environment,
                pass_fds=(telling.fileno(), commands.fileno()),
                start_new_session=True,  # Ctrl-C is for its parent, which may still have to bring a robot to a stand
            )
        try:
            self._await_ready(site)
        except BaseException:
            self.stop()
            raise

    @property
    def pid(self) -> int:
        """The child's process."""
        return self._process.pid

    def request(self, **word: Any) -> None:
        """Have a topic opened; nothing where the child has ended, which `hear` says."""
        with contextlib.suppress(OSError):
            self._commands.send(bytes([WORD]) + json.dumps(word).encode())

    def publish(self, index: int, payload: bytes) -> bool:
        """Hand over a command without waiting; False where the child has ended or takes no more."""
        packet = _COMMAND.pack(MESSAGE, index, time.monotonic()) + payload
        try:
            self._commands.send(packet, socket.MSG_DONTWAIT)
        except OSError:
            return False
        return True

    def read_messages(
        self, message: Callable[[int, bytes], None], word: Callable[[dict[str, Any]], None]
    ) -> None:
        """Hand over all that the child tells, until it ends or is ended."""
        with contextlib.suppress(EOFError, OSError):
            while True:
                kind, index, payload = self._next()
                if kind == MESSAGE:
                    message(index, payload)
                else:
                    word(json.loads(payload))

    def interrupt(self) -> None:
        """Let `hear` return, from another thread."""
        for one in (self._telling, self._commands):
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)

    def stop(self) -> int:
        """Close the sockets and wait for the child, which takes leave of the master; returns how it ended."""
        self.interrupt()
        self._telling.close()
        self._commands.close()
        try:
            return self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self._process.wait()

    def _await_ready(self, site: RosEnvironment) -> None:
        """Wait for its first word."""
        self._telling.settimeout(_START_S)
        try:
            _, _, payload = self._next()
        except TimeoutError:
            raise TransportError(
                f"rospy, run by {site.python}, did not start within {_START_S:g} s"
            ) from None
        except (EOFError, OSError) as error:
            raise TransportError(
                f"rospy, run by {site.python}, ended at its start; see its output"
            ) from error
        self._telling.settimeout(None)
        failed = json.loads(payload).get("failed")
        if failed is not None:
            raise TransportError(
                f"no ROS master is to be reached at {site.master}: {failed}; start roscore there, or say in "
                "transport.master where it is"
            )

    def _next(self) -> tuple[int, int, bytes]:
        """Kind, topic and bytes of what comes next."""
        kind, index, size = _HEAD.unpack(self._exactly(_HEAD.size))
        return kind, index, self._exactly(size)

    def _exactly(self, size: int) -> bytes:
        parts: list[bytes] = []
        while size:
            part = self._telling.recv(size, socket.MSG_WAITALL)
            if not part:
                raise EOFError
            parts.append(part)
            size -= len(part)
        return (
            parts[0] if len(parts) == 1 else b"".join(parts)
        )  # one, unless a signal came: no picture is copied
