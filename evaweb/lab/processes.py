"""The processes of a lab: started with a lifeline, restarted when they die, ended in order.

A child's standard input is a pipe whose other end only we hold. It closes when we end, however we end, and
every program of ours ends by itself then: nothing is ever looked for and killed.
"""

from __future__ import annotations

import json
import logging
import os
import selectors
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from evaweb.errors import EvaError
from runtime.core.environment import without_secrets

log = logging.getLogger(__name__)
_MOST_RESTARTS, _RESTART_WINDOW_S = 5, 60.0
_REST_S = 30.0
_MOST_PROCESSOR_S = 300.0  # of a program that gets ready
_LONGEST_LOG = 20_000_000  # bytes, beyond which a log starts anew and the old one is kept beside it


class LabError(EvaError):
    """The lab cannot start or go on; the message says which part and why."""


@dataclass(frozen=True)
class Program:
    """One process: `python ARGUMENTS --lifeline`.

    One that `announces` prints its addresses as a line of JSON when it is ready; started again after a death
    it gets the arguments that `again` makes of them, so that it is found where it was.
    """

    name: str
    arguments: tuple[str, ...]
    announces: bool = False
    again: Callable[[Mapping[str, Any]], tuple[str, ...]] | None = None
    patience_s: float = 5.0  # to end by itself
    nice: int = 0  # above 0: told to give way to the stations of this machine once it is ready (--nice)
    descriptors: tuple[int, ...] = ()  # of our files that it has too, under the same numbers
    of_web: bool = False  # gets the web's secrets; no other program has them in its environment


@dataclass
class _Child:
    program: Program
    process: subprocess.Popen[bytes]
    log: IO[bytes]
    addresses: Mapping[str, Any] = field(default_factory=dict)
    restarts: deque[float] = field(default_factory=deque)
    rests_until: float = 0.0


class Processes:
    """All children; `start` in order, `watch` now and then, `end` in reverse order."""

    def __init__(self, folder: Path, logs: Path, environment: Mapping[str, str]) -> None:
        self._folder = folder
        self._logs = logs
        self._environment = dict(environment)
        self._children: dict[str, _Child] = {}
        logs.mkdir(parents=True, exist_ok=True)

    def start(self, program: Program, ready_s: float = 60.0) -> Mapping[str, Any]:
        """Start it; returns the addresses that it announces, {} where it announces none.

        It may be slow, as its machine is: LabError where it does nothing for `ready_s`, or far too much.
        """
        child = _Child(program, *self._spawn(program, program.arguments, program.announces))
        self._children[program.name] = child
        if program.announces:
            child.addresses = self._announcement(child, ready_s)
        return child.addresses

    def pids(self) -> dict[str, int]:
        """The processes that there are now."""
        return {name: child.process.pid for name, child in self._children.items()}

    def watch(self) -> None:
        """Restart what has died, without waiting for it.

        What dies too often rests a while between two starts: it must not take a station with it that runs.
        """
        now = time.monotonic()
        for child in self._children.values():
            code = child.process.poll()
            if code is not None and now >= child.rests_until:
                self._restart(child, code, now)

    def end(self) -> None:
        """Cut the lifelines in reverse order, wait for each; one that does not end in its time is killed."""
        for child in reversed(self._children.values()):
            assert child.process.stdin is not None
            child.process.stdin.close()
        for child in reversed(self._children.values()):
            try:
                child.process.wait(child.program.patience_s)
            except subprocess.TimeoutExpired:
                log.error("%s does not end by itself: killed", child.program.name)
                child.process.kill()
                child.process.wait()
            child.log.close()
        self._children.clear()

    def _spawn(
        self, program: Program, arguments: tuple[str, ...], heard: bool
    ) -> tuple[subprocess.Popen[bytes], IO[bytes]]:
        path = self._logs / f"{program.name}.log"
        if path.exists() and path.stat().st_size > _LONGEST_LOG:
            path.replace(path.with_suffix(".log.old"))
        output = path.open("ab")
        yields = ("--nice", str(program.nice)) if program.nice else ()
        process = subprocess.Popen(
            [sys.executable, *arguments, *yields, "--lifeline"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE if heard else output,
            stderr=output,
            env=self._environment if program.of_web else without_secrets(self._environment),
            cwd=self._folder,
            pass_fds=program.descriptors,
            start_new_session=True,  # Ctrl-C reaches us alone; we end them in order
        )
        return process, output

    def _announcement(self, child: _Child, ready_s: float) -> Mapping[str, Any]:
        output = child.process.stdout
        assert output is not None
        used, since = 0.0, time.monotonic()
        with selectors.DefaultSelector() as selector:
            selector.register(output, selectors.EVENT_READ)
            while not selector.select(0.2):
                now, before, used = time.monotonic(), used, processor_s(child.process.pid)
                since = since if used == before else now
                if used > _MOST_PROCESSOR_S or now - since > ready_s:
                    spent = f"{used:g} s of the processor, nothing for {now - since:.0f} s"
                    raise LabError(f"{child.program.name} does not get ready ({spent}): {self._why(child)}")
        line = output.readline()
        try:
            found = json.loads(line)
        except ValueError:
            child.process.wait(5)
            raise LabError(f"{child.program.name} did not start: {self._why(child)}") from None
        if not isinstance(found, dict):
            raise LabError(f"{child.program.name} announced {found!r}; expected a map of addresses")
        return found

    def _why(self, child: _Child) -> str:
        path = self._logs / f"{child.program.name}.log"
        lines = path.read_text("utf-8", "replace").strip().splitlines()
        return f"{lines[-1] if lines else 'it said nothing'} (see {path})"

    def _restart(self, child: _Child, code: int, now: float) -> None:
        """Start it again where it was; what it announces is known and goes to its log."""
        program = child.program
        while child.restarts and child.restarts[0] < now - _RESTART_WINDOW_S:
            child.restarts.popleft()
        if len(child.restarts) >= _MOST_RESTARTS:
            child.rests_until = now + _REST_S
            child.restarts.clear()
            log.error(
                "%s ended with %d, %d times within a minute: next try in %d s; %s",
                program.name,
                code,
                _MOST_RESTARTS + 1,
                _REST_S,
                self._why(child),
            )
            return
        child.restarts.append(now)
        log.error("%s ended with %d: restarting it", program.name, code)
        child.log.close()
        arguments = program.again(child.addresses) if program.again else program.arguments
        child.process, child.log = self._spawn(program, arguments, heard=False)


def processor_s(pid: int) -> float:
    """Processor time of that process, and of those it has waited for [s]; 0 of one that has ended."""
    try:
        told = Path(f"/proc/{pid}/stat").read_text("ascii", "replace")
    except OSError:
        return 0.0
    return sum(map(int, told.rpartition(")")[2].split()[11:15])) / os.sysconf("SC_CLK_TCK")
