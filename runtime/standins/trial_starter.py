"""Starter of trials: `python -m runtime.standins.trial_starter CHANNEL`, which forks a process for each trial.

Half of a short trial in a fresh process is imports, compiled kernels and models. This process loads them once; each
trial is `runtime.standins.trial` in a fork of it, which nothing precedes but loading. CHANNEL is the descriptor of a
socket, on which each message has the arguments and the environment variables of a trial as JSON, and four descriptors:
standard input, output and error of the trial, and a pipe for its process id and its exit code. It ends when standard
input ends, or after a minute without work.
"""

from __future__ import annotations

import gc
import importlib
import json
import os
import selectors
import shlex
import signal
import socket
import sys
from collections.abc import Sequence
from contextlib import suppress

from runtime.benches.schema import load_schema
from runtime.config import loader
from runtime.core.clock import VirtualClock
from runtime.core.errors import RuntimeFault
from runtime.simulation import environments
from runtime.simulation.node import parser as node_parser
from runtime.standins import serve, trial
from runtime.standins.lockstep import bench_of
from runtime.station.checks import check_deployment

IDLE_S = 60.0
_DESCRIPTORS = 4
_MESSAGE = 1 << 16  # [bytes] of arguments at most
_LATE_IMPORTS = (  # what a trial would import when it begins
    "runtime.simulation.contact.bench",
    "runtime.simulation.render",
    "runtime.standins.openpi_server",
)


class TrialStarter:
    """Loop that forks a trial for each message; call `run` in a process without other threads."""

    def __init__(self, channel: socket.socket) -> None:
        self._channel = channel
        self._loaded: set[tuple[str, ...]] = set()
        self._running: dict[int, tuple[int, int]] = {}  # by descriptor of a process: its id and its pipe
        self._selector = selectors.DefaultSelector()
        self._selector.register(0, selectors.EVENT_READ)
        self._selector.register(channel, selectors.EVENT_READ)

    def run(self) -> None:
        """Start trials until standard input ends, or until there has been none for IDLE_S."""
        for name in _LATE_IMPORTS:
            importlib.import_module(name)
        while True:
            ready = self._selector.select(None if self._running else IDLE_S)
            if not ready:
                return
            for key, _ in ready:
                if key.fd == 0:
                    if not os.read(0, 4096):
                        return
                elif key.fd == self._channel.fileno():
                    self._start_next()
                else:
                    self._reap(key.fd)

    def _start_next(self) -> None:
        message, descriptors, _, _ = socket.recv_fds(self._channel, _MESSAGE, _DESCRIPTORS)
        if not message:
            self._selector.unregister(self._channel)
            return
        arguments, variables = json.loads(message)
        self._load(arguments)
        child = os.fork()
        if child == 0:
            os.environ.update(variables)
            self._run_trial(arguments, descriptors)
        *streams, pipe = descriptors
        for descriptor in streams:
            os.close(descriptor)
        with suppress(BrokenPipeError):
            os.write(pipe, f"{child}\n".encode())
        process = os.pidfd_open(child)
        self._running[process] = child, pipe
        self._selector.register(process, selectors.EVENT_READ)

    def _run_trial(self, arguments: Sequence[str], descriptors: Sequence[int]) -> None:
        """Run the trial in this process, a fork, and end it."""
        code = 1
        try:
            self._selector.close()
            self._channel.close()
            for process, (_, pipe) in self._running.items():
                os.close(process)
                os.close(pipe)
            for number, descriptor in enumerate(descriptors[:3]):
                os.dup2(descriptor, number)
            for descriptor in descriptors:
                os.close(descriptor)
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            code = trial.main(arguments)
        except SystemExit as end:  # of the parser of arguments, which has said why
            code = end.code if isinstance(end.code, int) else 1
        except BaseException:
            sys.excepthook(*sys.exc_info())
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)  # nothing of the starter is to run in the fork

    def _load(self, arguments: Sequence[str]) -> None:
        """Load once what trials with these arguments load: robot, kernels, models of bench and policy."""
        try:
            options = trial.parser().parse_args(arguments)
        except SystemExit:
            return  # the trial says it, in its own process and to its own standard error
        key = (str(options.deployment), options.bench or "", (options.serve or "").partition(" --seed")[0])
        if key in self._loaded:
            return
        self._loaded.add(key)
        try:
            spec = check_deployment(loader.load(options.deployment, options.assignments))
            if options.serve:
                serve.build_server(serve.parser().parse_args(shlex.split(options.serve)), VirtualClock())
            bench = options.bench or bench_of(spec)
            if bench in environments.OWN or load_schema(bench).program is None:
                size = ("--width", str(options.width), "--height", str(options.height))
                given = node_parser().parse_args(["--robot", spec.robot.name, "--bench", bench, *size])
                environments.make_environment(spec.robot, given).pictures(0, 0.0, spec.robot.poses["home"])
        except RuntimeFault:
            return  # as above
        gc.collect()
        gc.freeze()  # the collector of a fork need not touch, and so copy, what is loaded

    def _reap(self, process: int) -> None:
        child, pipe = self._running.pop(process)
        self._selector.unregister(process)
        os.close(process)
        _, status = os.waitpid(child, 0)
        with suppress(BrokenPipeError):  # who ordered the trial may no longer wait for it
            os.write(pipe, f"{os.waitstatus_to_exitcode(status)}\n".encode())
        os.close(pipe)


def main(arguments: Sequence[str] | None = None) -> int:
    """Start trials until standard input ends."""
    (channel,) = sys.argv[1:] if arguments is None else arguments
    with socket.socket(fileno=int(channel)) as orders:
        TrialStarter(orders).run()
    return 0


if __name__ == "__main__":
    sys.exit(main())
