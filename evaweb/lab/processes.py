"""Processes of a lab: started with a lifeline, restarted when they end, and ended in order.

The standard input of a child is a pipe whose other end only this process holds. The pipe closes when this process
ends, for whatever reason, and all our programs end by themselves then: no process ever has to be searched and killed.
"""

from __future__ import annotations

import contextlib
import json
import logging
import math
import os
import selectors
import subprocess
import sys
import time
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from evaweb.core.errors import EvaError
from runtime.core.environment import without_web_secrets
from runtime.core.restart_window import MOST_RESTARTS, RestartWindow

log = logging.getLogger(__name__)
_REST_S = 30.0
_MOST_PROCESSOR_S = 300.0  # processor time for getting ready
_LONGEST_LOG = 20_000_000  # [bytes] size at which a log is rotated; one old log is kept


Starting = Generator[None, None, Mapping[str, Any]]  # returns the addresses that the program announced


class LabError(EvaError):
    """Error if the lab cannot start or continue; the message names part and reason."""


@dataclass(frozen=True)
class ProgramSpec:
    """Specification of a program: the process `python ARGUMENTS --lifeline`.

    If `announces` is set, the program prints its addresses as a line of JSON when it is ready. `again` converts these
    addresses to arguments for a restart, so that the restarted program listens at the same addresses.
    """

    name: str
    arguments: tuple[str, ...]
    announces: bool = False
    again: Callable[[Mapping[str, Any]], tuple[str, ...]] | None = None
    patience_s: float = 5.0  # time to end by itself
    nice: int = 0  # above 0: lower priority than the stations of this machine, set when it is ready (--nice)
    descriptors: tuple[int, ...] = ()  # file descriptors that it inherits, with the same numbers
    of_web: bool = False  # gets the web's secrets; other programs do not have them in their environment


@dataclass
class _Child:
    program: ProgramSpec
    process: subprocess.Popen[bytes]
    log: IO[bytes]
    addresses: Mapping[str, Any] = field(default_factory=dict)
    restarts: RestartWindow = field(default_factory=RestartWindow)
    rests_until: float = 0.0
    coming: bool = False  # getting ready, not announced yet
    killed_at: float = 0.0  # time at which a dropped process is killed if it has not ended


class ChildProcesses:
    """Child processes; `start` in order, `watch` regularly, `end` in reverse order."""

    def __init__(self, folder: Path, logs: Path, environment: Mapping[str, str]) -> None:
        self._folder = folder
        self._logs = logs
        self._environment = dict(environment)
        self._children: dict[str, _Child] = {}
        self._ending: list[_Child] = []  # dropped, but not ended yet
        logs.mkdir(parents=True, exist_ok=True)

    def start(self, program: ProgramSpec, ready_s: float = 60.0) -> Mapping[str, Any]:
        """Start a program and wait until it is ready; return the addresses that it announces, {} if none.

        Raises:
            LabError: If the program makes no progress for `ready_s` [s], uses too much processor time, or fails. On a
                slow machine, a program that makes progress is waited for.
        """
        return self.begin(program, ready_s)()

    def begin(self, program: ProgramSpec, ready_s: float = 60.0) -> Callable[[], Mapping[str, Any]]:
        """Start a program in parallel with others; call the returned function to wait until it is ready, as
        `start` does.
        """
        begun = self.starting(program, ready_s, wait_s=0.2)
        announcements: list[Mapping[str, Any]] = []

        def look() -> None:
            try:
                next(begun)
            except StopIteration as ready:
                announcements.append(ready.value)

        def wait() -> Mapping[str, Any]:
            while not announcements:
                look()
            return announcements[0]

        look()
        return wait

    def starting(self, program: ProgramSpec, ready_s: float = 60.0, wait_s: float = 0.0) -> Starting:
        """Start a program as a generator, whose steps take at most `wait_s` [s], so that the caller can do other work.

        A program that does not get ready is ended and removed.
        """
        if program.name in self._children:
            raise LabError(f"{program.name} is a program of this lab already: give it another name")
        child = _Child(program, *self._spawn(program, program.arguments, program.announces))
        self._children[program.name] = child
        if not program.announces:
            return child.addresses
        child.coming = True
        try:
            child.addresses = yield from self._announcement(child, ready_s, wait_s)
        except Exception:
            self.drop(program.name)
            raise
        child.coming = False
        return child.addresses

    def drop(self, name: str) -> None:
        """End a child for good without waiting; `watch` detects its end. Unknown names are ignored."""
        child = self._children.pop(name, None)
        if child is not None:
            self._cut(child)
            child.killed_at = time.monotonic() + child.program.patience_s
            self._ending.append(child)

    def ending(self) -> set[str]:
        """Return the names of the children that are dropped but have not ended."""
        return {child.program.name for child in self._ending}

    def pids(self) -> dict[str, int]:
        """Return the current process ids by name."""
        return {name: child.process.pid for name, child in self._children.items()}

    def watch(self) -> None:
        """Restart children that ended, without waiting for them.

        A child that ends too often is restarted after a pause, so that it does not affect running stations.
        """
        now = time.monotonic()
        self._ending = [child for child in self._ending if not self._ended(child, now)]
        for child in self._children.values():
            code = child.process.poll()
            if code is not None and not child.coming and now >= child.rests_until:
                self._restart(child, code, now)

    def end(self) -> None:
        """Close the lifelines in reverse order and wait; children that do not end in time are killed."""
        for child in reversed(self._children.values()):
            self._cut(child)
        for child in (*self._ending, *reversed(self._children.values())):
            self._wait(child)
        self._ending.clear()
        self._children.clear()

    def _cut(self, child: _Child) -> None:
        assert child.process.stdin is not None
        child.process.stdin.close()

    def _ended(self, child: _Child, now: float) -> bool:
        """Return True if the child has ended; kill it if it has not ended by itself in time."""
        if child.process.poll() is not None:
            child.log.close()
            return True
        if now >= child.killed_at:
            log.error("%s does not end by itself: killed", child.program.name)
            child.process.kill()
            child.killed_at = math.inf
        return False

    def _wait(self, child: _Child) -> None:
        try:
            child.process.wait(child.program.patience_s)
        except subprocess.TimeoutExpired:
            log.error("%s does not end by itself: killed", child.program.name)
            child.process.kill()
            child.process.wait()
        child.log.close()

    def _spawn(
        self, program: ProgramSpec, arguments: tuple[str, ...], heard: bool
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
            env=self._environment if program.of_web else without_web_secrets(self._environment),
            cwd=self._folder,
            pass_fds=program.descriptors,
            start_new_session=True,  # Ctrl-C reaches only this process, which ends them in order
        )
        return process, output

    def _announcement(self, child: _Child, ready_s: float, wait_s: float) -> Starting:
        output = child.process.stdout
        assert output is not None
        used, since = 0.0, time.monotonic()
        yield  # it has been started
        with selectors.DefaultSelector() as selector:
            selector.register(output, selectors.EVENT_READ)
            while not selector.select(wait_s):
                now, before, used = time.monotonic(), used, processor_s(child.process.pid)
                since = since if used == before else now
                if used > _MOST_PROCESSOR_S or now - since > ready_s:
                    spent = f"{used:g} s of the processor, nothing for {now - since:.0f} s"
                    raise LabError(f"{child.program.name} does not get ready ({spent}): {self._why(child)}")
                yield
        line = output.readline()
        try:
            announcement = json.loads(line)
        except ValueError:
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.process.wait(5)
            raise LabError(f"{child.program.name} did not start: {self._why(child)}") from None
        if not isinstance(announcement, dict):
            raise LabError(f"{child.program.name} announced {announcement!r}; expected a map of addresses")
        return announcement

    def _why(self, child: _Child) -> str:
        path = self._logs / f"{child.program.name}.log"
        lines = path.read_text("utf-8", "replace").strip().splitlines()
        return f"{lines[-1] if lines else 'no output'} (see {path})"

    def _restart(self, child: _Child, code: int, now: float) -> None:
        """Restart a child with the addresses that it had announced; its new announcement goes to its log.

        A child that has ended too often is not restarted before a pause.
        """
        program = child.program
        if not child.restarts.admit(now):
            child.rests_until = now + _REST_S
            child.restarts.clear()
            log.error(
                "%s ended with %d, %d times within a minute: next try in %d s; %s",
                program.name,
                code,
                MOST_RESTARTS + 1,
                _REST_S,
                self._why(child),
            )
            return
        log.error("%s ended with %d: restarting it", program.name, code)
        child.log.close()
        arguments = program.again(child.addresses) if program.again else program.arguments
        child.process, child.log = self._spawn(program, arguments, heard=False)


def processor_s(pid: int) -> float:
    """Return the processor time of a process and of the children it has waited for [s]; 0 if it has ended."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text("ascii", "replace")
    except OSError:
        return 0.0
    return sum(map(int, text.rpartition(")")[2].split()[11:15])) / os.sysconf("SC_CLK_TCK")
