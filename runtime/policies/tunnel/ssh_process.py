"""ssh process with one forwarded local port, its messages, and the check that it listens there."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
from collections import deque
from collections.abc import Sequence
from pathlib import Path

from runtime.core.environment import ssh_environment

_LISTEN = "0A"
_LOOPBACK = int.from_bytes(socket.inet_aton("127.0.0.1"), sys.byteorder)


def is_listening(pid: int, port: int) -> bool:
    """Return True if the process `pid`, and no other, accepts connections on 127.0.0.1:`port`.

    This is read from the kernel's tables: a test connection would reach the policy server, and could not tell our
    process from another one on that port.
    """
    sockets = _sockets(pid)
    return any(f"socket:[{inode}]" in sockets for inode in _listeners(pid, port)) if sockets else False


def _listeners(pid: int, port: int) -> list[str]:
    """Return the inodes of the sockets that listen at `port` in the network namespace of the process `pid`."""
    local_address = f"{_LOOPBACK:08X}:{port:04X}"
    try:
        rows = [line.split() for line in Path(f"/proc/{pid}/net/tcp").read_text("ascii").splitlines()[1:]]
    except OSError:  # it has ended
        return []
    return [row[9] for row in rows if row[1] == local_address and row[3] == _LISTEN]


def _sockets(pid: int) -> set[str]:
    targets = set()
    try:
        for entry in os.scandir(f"/proc/{pid}/fd"):
            try:
                targets.add(os.readlink(entry.path))
            except OSError:  # closed meanwhile
                continue
    except OSError:  # it has ended
        return set()
    return targets


_BOUND = Path(__file__).with_name("die_with_parent.py")
_PATIENCE_S = 2.0  # time for its end after SIGTERM [s]
_LINES, _WIDTH = 20, 300  # stored lines of its output, and their longest width
_WORD = b"eva-tunnel"  # text that the far end echoes
_REFUSED = re.compile(r"channel \d+: open failed: (.+)")


def free_port() -> int:
    """Return a loopback port on which nothing listens; another process may take it before it is used."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Ssh:
    """ssh process in a session of its own, which ends with the thread that started it and with this process.

    With `echoes` it runs a remote command that echoes its input; the local port counts as usable only after the first
    echo.
    """

    def __init__(self, command: Sequence[str], port: int, echoes: bool = False) -> None:
        self.port = port
        self.said: deque[str] = deque(maxlen=_LINES)
        self.refusal = ""  # reason of the newest connection that the far end refused
        self.refusals = 0  # number of refused connections
        self._echoed = not echoes
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", str(_BOUND), str(os.getpid()), *command],
            stdin=subprocess.PIPE if echoes else subprocess.DEVNULL,  # the remote command ends with this pipe
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=ssh_environment(),
            start_new_session=True,  # without a terminal, because no person can answer
        )
        self._pipes = [pipe for pipe in (self._process.stdout, self._process.stderr) if pipe is not None]
        self._rests = {pipe.fileno(): b"" for pipe in self._pipes}
        for pipe in self._pipes:
            os.set_blocking(pipe.fileno(), False)
        if self._process.stdin is not None:
            self._pipes.append(self._process.stdin)
            with contextlib.suppress(BrokenPipeError):  # it has ended, which `poll` reports
                os.write(self._process.stdin.fileno(), _WORD + b"\n")

    @property
    def pid(self) -> int:
        return self._process.pid

    def poll(self) -> int | None:
        """Read pending ssh output; return the exit code, or None while it runs."""
        code = self._process.poll()  # first, so that all its output can be read if it has ended
        for pipe in self._rests:
            self._read(pipe)
            if code is not None and self._rests[pipe]:
                self._handle_line(pipe, b"\n")
        return code

    def is_listening(self) -> bool:
        """Return True if the local port accepts connections and the far end has responded."""
        return self._echoed and is_listening(self.pid, self.port)

    def terminate(self) -> None:
        """End ssh and its children, and wait until they have ended."""
        if self._process.poll() is None:  # not reaped yet, so its session id cannot belong to another process
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.pid, signal.SIGTERM)
            try:
                self._process.wait(_PATIENCE_S)
            except subprocess.TimeoutExpired:
                os.killpg(self.pid, signal.SIGKILL)
                self._process.wait()
        for pipe in self._pipes:
            pipe.close()
        self._pipes.clear()
        self._rests.clear()

    def _read(self, pipe: int) -> None:
        while True:
            try:
                piece = os.read(pipe, 4096)
            except BlockingIOError:
                return
            if not piece:
                return
            self._handle_line(pipe, piece)

    def _handle_line(self, pipe: int, piece: bytes) -> None:
        *lines, remainder = (self._rests[pipe] + piece).split(b"\n")
        self._rests[pipe] = remainder[-_WIDTH:]
        for line in lines:
            if line == _WORD:
                self._echoed = True
                continue
            text = "".join(c if c.isprintable() else " " for c in line.decode("utf-8", "replace")).strip()[
                :_WIDTH
            ]
            refused = _REFUSED.fullmatch(text)
            if refused:
                self.refusal, self.refusals = refused[1], self.refusals + 1
            elif text:
                self.said.append(text)
