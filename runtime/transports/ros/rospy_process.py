"""Child process for rospy, which a process can start only once and which changes its logging and signals.

The child is a separate program (rospy_node), run by a Python that has rospy. Two sockets connect it with its parent: a
stream of received messages, each preceded by kind, topic and size; and packets of commands (kind, topic, creation
time), which are sent without waiting. Control words are JSON. When the sockets close, the child ends.
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

MESSAGE, WORD = 1, 2  # the same numbers as in rospy_node, which cannot import this module
_HEAD = struct.Struct("<BxHI")
_COMMAND = struct.Struct("<BxHd")
_PROGRAM = Path(__file__).parent / "rospy_node" / "__main__.py"
_ROOM = 4 << 20  # socket buffer [bytes], if the system permits: one picture fits
_START_S = 20.0
_END_S = 2.0
_INSTALL = (
    "install it (Debian: apt-get install python3-rospy python3-sensor-msgs), or name in transport.python the Python of "
    "a ROS 1 installation, with its setup.bash sourced"
)


@dataclass(frozen=True, slots=True)
class RosEnvironment:
    """ROS 1 environment: the Python that has rospy, the master, and this machine's address for other nodes."""

    python: str
    master: str
    address: str

    @property
    def environment(self) -> dict[str, str]:
        """Environment variables for the child: those of this process, with those that rospy reads replaced."""
        inherited = {
            name: value
            for name, value in os.environ.items()
            if name not in ("ROS_HOSTNAME", "ROS_NAMESPACE", "ROS_PYTHON_LOG_CONFIG_FILE")
        }
        return inherited | {"ROS_MASTER_URI": self.master, "ROS_IP": self.address}


@functools.cache  # cache: to look starts a process
def require(python: str) -> None:
    """Raise SetupError with an instruction unless `python` exists and has rospy; a success is cached."""
    line = [python, str(_PROGRAM), json.dumps({"check": True})]
    try:
        completed = subprocess.run(
            line, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=_START_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise SetupError(f"transport.python = {python!r} cannot be run: {error}; {_INSTALL}") from error
    if completed.returncode:
        message = (completed.stderr.strip().splitlines() or [f"it ended with {completed.returncode}"])[-1]
        raise SetupError(f"ROS 1 needs rospy, which {python} (transport.python) lacks: {message}; {_INSTALL}")


class RospyProcess:
    """One child process with a node that is registered at the master."""

    def __init__(self, site: RosEnvironment, name: str) -> None:
        """Start the child. Raises SetupError without rospy, TransportError if the master does not answer."""
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
                start_new_session=True,  # Ctrl-C goes to the parent, which may still have to stop a robot
            )
        try:
            self._await_ready(site)
        except BaseException:
            self.stop()
            raise

    @property
    def pid(self) -> int:
        """Process id of the child."""
        return self._process.pid

    def request(self, **word: Any) -> None:
        """Request the child to open a topic. Does nothing if the child has ended; `read_messages` then returns."""
        with contextlib.suppress(OSError):
            self._commands.send(bytes([WORD]) + json.dumps(word).encode())

    def publish(self, index: int, payload: bytes) -> bool:
        """Send a command without waiting; return False if the child has ended or its socket is full."""
        packet = _COMMAND.pack(MESSAGE, index, time.monotonic()) + payload
        try:
            self._commands.send(packet, socket.MSG_DONTWAIT)
        except OSError:
            return False
        return True

    def read_messages(
        self, message: Callable[[int, bytes], None], word: Callable[[dict[str, Any]], None]
    ) -> None:
        """Read what the child sends, until the child ends or `interrupt` is called.

        `message` is called with the index of the topic and the bytes of each ROS message. `word` is called with the
        fields of each report of the child about itself.
        """
        with contextlib.suppress(EOFError, OSError):
            while True:
                kind, index, payload = self._next()
                if kind == MESSAGE:
                    message(index, payload)
                else:
                    word(json.loads(payload))

    def interrupt(self) -> None:
        """Make `read_messages` return; call it from another thread."""
        for connection in (self._telling, self._commands):
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)

    def stop(self) -> int:
        """Close the sockets and wait until the child has deregistered; return its exit code."""
        self.interrupt()
        self._telling.close()
        self._commands.close()
        try:
            return self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self._process.wait()

    def _await_ready(self, site: RosEnvironment) -> None:
        """Wait until the child reports that it runs. Raises TransportError if it did not start or found no master."""
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
        """Return kind, topic and bytes of the next message."""
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
        )  # a single part unless a signal interrupted: pictures are not copied
