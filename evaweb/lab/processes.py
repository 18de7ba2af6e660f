"""The processes of a lab: started with a lifeline, restarted when they die, ended in order.

A child's standard input is a pipe whose other end only we hold. It closes when we end, however we end, and
every program of ours ends by itself then: nothing is ever looked for and killed.
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
from collections import deque
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from evaweb.errors import EvaError
from runtime.core.environment import without_web_secrets

log = logging.getLogger(__name__)
_MOST_RESTARTS, _RESTART_WINDOW_S = 5, 60.0
_REST_S = 30.0
_MOST_PROCESSOR_S = 300.0  # of a program that gets ready
_LONGEST_LOG = 20_000_000  # bytes, beyond which a log starts anew and the old one is kept beside it


Starting = Generator[None, None, Mapping[str, Any]]  # it returns the addresses that the program announced


class LabError(EvaError):
    """The lab cannot start or go on; the message says which part and why."""


@dataclass(frozen=True)
class ProgramSpec:
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
    program: ProgramSpec
    process: subprocess.Popen[bytes]
    log: IO[bytes]
    addresses: Mapping[str, Any] = field(default_factory=dict)
    restarts: deque[float] = field(default_factory=deque)
    rests_until: float = 0.0
    coming: bool = False  # it gets ready, and has not announced itself
    killed_at: float = 0.0  # when one that is dropped is killed, unless it has ended


class ChildProcesses:
    """All children; `start` in order, `watch` now and then, `end` in reverse order."""

    def __init__(self, folder: Path, logs: Path, environment: Mapping[str, str]) -> None:
        self._folder = folder
        self._logs = logs
        self._environment = dict(environment)
        self._children: dict[str, _Child] = {}
        self._ending: list[_Child] = []  # dropped, and not seen to have ended
        logs.mkdir(parents=True, exist_ok=True)

    def start(self, program: ProgramSpec, ready_s: float = 60.0) -> Mapping[str, Any]:
        """Start it; returns the addresses that it announces, {} where it announces none.

        It may be slow, as its machine is: LabError where it does nothing for `ready_s`, or far too much.
        """
        return self.begin(program, ready_s)()

    def begin(self, program: ProgramSpec, ready_s: float = 60.0) -> Callable[[], Mapping[str, Any]]:
        """Start it, while others are being started; what is returned waits until it is ready, as `start` does."""
        begun = self.starting(program, ready_s, wait_s=0.2)
        found: list[Mapping[str, Any]] = []

        def look() -> None:
            try:
                next(begun)
            except StopIteration as ready:
                found.append(ready.value)

        def wait() -> Mapping[str, Any]:
            while not found:
                look()
            return found[0]

        look()
        return wait

    def starting(self, program: ProgramSpec, ready_s: float = 60.0, wait_s: float = 0.0) -> Starting:
        """The same, a look at a time of at most `wait_s`: what else there is to watch is watched between two looks.

        One that does not start is ended, and is none of ours any more.
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
        """End one of them for good, waiting for nothing: `watch` sees it end. One that there is not is none."""
        child = self._children.pop(name, None)
        if child is not None:
            self._cut(child)
            child.killed_at = time.monotonic() + child.program.patience_s
            self._ending.append(child)

    def ending(self) -> set[str]:
        """Names of those that are dropped and have not ended yet."""
        return {child.program.name for child in self._ending}

    def pids(self) -> dict[str, int]:
        """The processes that there are now."""
        return {name: child.process.pid for name, child in self._children.items()}

    def watch(self) -> None:
        """Restart what has died, without waiting for it.

        What dies too often rests a while between two starts: it must not take a station with it that runs.
        """
        now = time.monotonic()
        self._ending = [child for child in self._ending if not self._ended(child, now)]
        for child in self._children.values():
            code = child.process.poll()
            if code is not None and not child.coming and now >= child.rests_until:
                self._restart(child, code, now)

    def end(self) -> None:
        """Cut the lifelines in reverse order, wait for each; one that does not end in its time is killed."""
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
        """True once it has ended; one whose time is over is killed."""
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
            start_new_session=True,  # Ctrl-C reaches us alone; we end them in order
        )
        return process, output

    def _announcement(self, child: _Child, ready_s: float, wait_s: float) -> Starting:
        output = child.process.stdout
        assert output is not None
        used, since = 0.0, time.monotonic()
        yield  # it has begun
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
            found = json.loads(line)
        except ValueError:
            with contextlib.suppress(subprocess.TimeoutExpired):
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
