"""Processes of trials: forks of one that has loaded what all of them need (`runtime.standins.trial_starter`)."""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import evaweb
from evaweb.core.errors import EvaError
from runtime.core.environment import without_web_secrets

_TRIES = 3
START_S = 180.0  # in which a starter loads what a trial needs, and starts it
_STARTER = ("-m", "runtime.standins.trial_starter")


class TrialProcess:
    """Process of one trial: `input` takes its orders, and its end kills it; `output` is its standard output."""

    def __init__(self, status: int, orders: int, answer: int) -> None:
        self.input, self.output = os.fdopen(orders, "wb"), os.fdopen(answer, "rb")
        self._status = os.fdopen(status, "r", encoding="ascii")
        pid = self._status.readline()  # empty: the starter has ended
        self.started = bool(pid)
        self._process: int | None = None
        with suppress(ProcessLookupError):  # it has ended already
            self._process = os.pidfd_open(int(pid)) if pid else None

    def kill(self) -> None:
        """Kill the process, if it is still running."""
        if self._process is not None:
            with suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._process, signal.SIGKILL)

    def wait(self) -> int:
        """Wait for its end and return its exit code; -1 if its starter has ended before it."""
        return int(self._status.readline() or "-1")

    def close(self) -> None:
        """Kill it if it is still running, and wait for its end."""
        with suppress(BrokenPipeError):
            self.input.close()
        self.output.close()
        if self._process is not None:
            select.select([self._process], [], [])
            os.close(self._process)
            self._process = None
        self._status.close()


class TrialProcesses:
    """Starter of trials of this process, which is itself started when it is first needed, and again after its end.

    `variables` are environment variables of the trials beside those of this process. Call `close` to end the starter
    before this process ends.
    """

    def __init__(self, variables: Mapping[str, str] | None = None) -> None:
        self._variables = dict(variables or {})
        self._lock = threading.Lock()
        self._starter: subprocess.Popen[bytes] | None = None
        self._channel: socket.socket | None = None

    def start(
        self, arguments: Sequence[str], log: Path, variables: Mapping[str, str] | None = None
    ) -> TrialProcess:
        """Start a trial with the arguments of `runtime.standins.trial`; its standard error is written to `log`.

        `variables` are environment variables of this trial.

        Raises:
            EvaError: If no process can be started.
        """
        for _ in range(_TRIES):  # a starter ends after a minute without work, perhaps just now
            taken, orders = os.pipe()
            answer, written = os.pipe()
            status, reported = os.pipe()
            with log.open("ab") as errors:
                try:
                    with self._lock:
                        starter, channel = self._running()
                        message = json.dumps([list(arguments), dict(variables or {})]).encode()
                        with suppress(BrokenPipeError, ConnectionResetError):
                            socket.send_fds(channel, [message], [taken, written, errors.fileno(), reported])
                finally:
                    for descriptor in (taken, written, reported):
                        os.close(descriptor)
            if not select.select([status], [], [], START_S)[0]:
                starter.kill()  # which ends all that waits for it, this too
            process = TrialProcess(status, orders, answer)
            if process.started:
                return process
            process.close()
            with self._lock:
                if self._starter is starter:
                    self._end_starter()
        raise EvaError("no process of a trial can be started; the log of the worker may say why")

    def close(self) -> None:
        """End the starter, and with it the trials that are still running."""
        with self._lock:
            self._end_starter()

    def _running(self) -> tuple[subprocess.Popen[bytes], socket.socket]:
        if self._starter is None or self._channel is None:
            self._channel, own = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            with own:
                self._starter = subprocess.Popen(
                    [sys.executable, *_STARTER, str(own.fileno())],
                    cwd=Path(evaweb.__file__).parents[1],
                    env=without_web_secrets(os.environ) | self._variables,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.DEVNULL,
                    pass_fds=(own.fileno(),),
                )
        return self._starter, self._channel

    def _end_starter(self) -> None:
        if self._channel is not None:
            self._channel.close()
        if self._starter is not None:
            assert self._starter.stdin is not None
            self._starter.stdin.close()
            self._starter.wait()
        self._channel = self._starter = None


PROCESSES = TrialProcesses()  # state: the starter of this process
