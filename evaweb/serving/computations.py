"""Long computations for pages: one child process, a CPU budget per user, cached results.

A caller waits in a request thread, of which the web has few: so few wait at a time, and not for long. Nothing that
stops a robot, keeps a lease or shows a page waits for them.
"""

from __future__ import annotations

import logging
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable
from concurrent.futures import Future
from functools import partial
from math import ceil
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from evaweb.accounts.lookup_pool import FairLookupPool, LookupQueueFull
from evaweb.core.errors import EvaError
from runtime.core.sentences import Pattern, fixed

log = logging.getLogger(__name__)
AT_ONCE_S = 30.0  # CPU budget of a user; a computation of the planner takes up to 10 s
REFILLED = 0.1  # budget regained per second [s/s]
_PATIENCE_S = 20.0  # longest wait of a request; the computation continues, and a retry finds its result
_SOON_S = 1.0  # longest wait of a page that retries by itself
_MOST_WAITING = 8  # waiting requests; the web serves 32 at a time
_MOST_ASKED = 32  # queued computations of all users
_KEPT = 512  # cached results
_AGAIN_S = 5
_NICE = 19
_ROOT = Path(__file__).parents[2]
_UNDER_WAY = fixed(
    "web.computing.under_way", "your question is being computed: ask it again in a few seconds"
)
_ONE_AT_A_TIME = fixed(
    "web.computing.one_at_a_time",
    "another question of yours is being computed; allowed: one at a time. Try again in a few seconds",
)
_SPENT = Pattern(
    "web.computing.spent",
    "your questions have taken {spent:.0f} s of computing; allowed: {at_once:g} s at once. Try again in {seconds:d} s",
)
_CROWDED = fixed("web.computing.crowded", "too many questions are being computed: try again in a few seconds")
_LOST = fixed("web.computing.lost", "the computing process has ended: try again; see the log of the web")


class Busy(EvaError):
    """Error if the result is not ready, or the user may not compute now.

    `retry_after_s` is the delay before a retry [s].
    """

    status = 503

    def __init__(self, sentence: str, retry_after_s: int = _AGAIN_S) -> None:
        super().__init__(sentence)
        self.retry_after_s = retry_after_s


class StillRunning(Busy):
    """Error if the computation is still running."""


class ComputeProcess:
    """Child process that computes; started by the first call and after it has ended. For one thread."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._wire: Connection[Any, Any] | None = None

    def run(self, work: Callable[..., Any], *given: Any) -> tuple[Any, float]:
        """Return the result of `work`, a module-level function, and its CPU time [s].

        Raises: Busy if the process was lost; any exception of `work`.
        """
        try:
            if self._wire is None:
                self._wire = self._start()
            self._wire.send((work, given))
            succeeded, result, seconds = self._wire.recv()
        except (EOFError, OSError) as error:
            log.error("the process that computes has ended: %r", error)
            self.end()
            raise Busy(_LOST) from error
        if not succeeded:
            raise result
        return result, seconds

    def _start(self) -> Connection[Any, Any]:
        own_end, child_end = socket.socketpair()
        with child_end:
            command = [sys.executable, "-m", "evaweb.serving.computations", str(child_end.fileno())]
            self._process = subprocess.Popen(
                command, pass_fds=[child_end.fileno()], stdin=subprocess.DEVNULL, cwd=_ROOT
            )
        return Connection(own_end.detach())

    def end(self) -> None:
        """Kill the process; the next call starts a new one."""
        if self._wire is not None:
            self._wire.close()
        if self._process is not None:
            self._process.kill()
            self._process.wait()
        self._wire = self._process = None


class Questions:
    """Queue of computations with cached results; `run` executes them one at a time.

    The users take turns, so that a user with many computations does not delay the others. The queue is thread-safe.
    """

    def __init__(
        self,
        run: Callable[..., tuple[Any, float]],
        clock: Callable[[], float] = time.monotonic,
        patience_s: float = _PATIENCE_S,
        soon_s: float = _SOON_S,
    ) -> None:
        self._run, self._clock, self._patience_s, self._soon_s = run, clock, patience_s, soon_s
        self._lock = threading.Lock()
        self._turns: FairLookupPool[Any] = FairLookupPool(1, _MOST_ASKED)
        self._kept: OrderedDict[Hashable, Any] = OrderedDict()
        self._asked: dict[
            Hashable, tuple[Hashable, Future[Any]]
        ] = {}  # by computation: the first user, and the future
        self._spent: dict[
            Hashable, tuple[float, float]
        ] = {}  # by user: CPU time spent [s], and when it was valid
        self._waiting = 0

    def result(self, person: Hashable, work: Callable[..., Any], *given: Any, soon: bool = False) -> Any:
        """Return the result of `work(*given)`, cached or computed.

        Args:
            person: User on whose CPU budget it is computed.
            soon: Wait only briefly, for a page that asks again by itself.

        Raises:
            StillRunning: The result is not ready in time; it continues to be computed.
            Busy: The user's budget is spent, another computation of theirs is running, or too many wait.
        """
        question = (work, given)
        with self._lock:
            if question in self._kept:
                self._kept.move_to_end(question)
                return self._kept[question]
            if self._waiting >= _MOST_WAITING:
                raise Busy(_CROWDED)
            coming = self._asked[question][1] if question in self._asked else self._begun(person, question)
            self._waiting += 1
        try:
            return coming.result(self._soon_s if soon else self._patience_s)
        except TimeoutError:
            raise StillRunning(_UNDER_WAY) from None
        except LookupQueueFull:
            raise Busy(_CROWDED) from None
        finally:
            with self._lock:
                self._waiting -= 1

    def compute(self, share: Hashable, work: Callable[..., Any], *given: Any) -> Any:
        """Return the result of `work(*given)` in the turn of `share`, however long it takes.

        Not for request threads.
        """
        result, _ = self._turns.submit(share, partial(self._run, work, *given)).result()
        return result

    def _begun(self, person: Hashable, question: tuple[Callable[..., Any], tuple[Any, ...]]) -> Future[Any]:
        if any(asker == person for asker, _ in list(self._asked.values())):
            raise Busy(_ONE_AT_A_TIME)
        spent = self._spent_by(person)
        if spent >= AT_ONCE_S:
            wait = ceil((spent - AT_ONCE_S) / REFILLED) + 1
            raise Busy(_SPENT(spent=spent, at_once=AT_ONCE_S, seconds=wait), wait)
        coming: Future[Any] = self._turns.submit(person, partial(self._answered, person, question))
        if not coming.done():  # otherwise it was refused for lack of room
            self._asked[question] = (person, coming)
            coming.add_done_callback(lambda _: self._asked.pop(question, None))
        return coming

    def _answered(self, person: Hashable, question: tuple[Callable[..., Any], tuple[Any, ...]]) -> Any:
        work, arguments = question
        result, seconds = self._run(work, *arguments)
        with self._lock:
            self._spent[person] = (self._spent_by(person) + seconds, self._clock())
            self._kept[question] = result
            while len(self._kept) > _KEPT:
                self._kept.popitem(last=False)
        return result

    def _spent_by(self, person: Hashable) -> float:
        seconds, at = self._spent.get(person, (0.0, 0.0))
        return max(0.0, seconds - REFILLED * (self._clock() - at))


questions = Questions(ComputeProcess().run)


def _main() -> None:
    """Answer calls over the inherited socket until the parent is gone."""
    wire = Connection(int(sys.argv[1]))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C in the terminal: the parent ends this process
    os.nice(_NICE)
    threading.Thread(target=_end_with, args=(wire.fileno(),), daemon=True).start()
    while True:
        try:
            work, arguments = wire.recv()
        except (EOFError, ConnectionError):
            return
        began = time.process_time()
        try:
            succeeded, result = True, work(*arguments)
        except Exception as fault:  # raised again in the parent
            succeeded, result = False, fault
        wire.send((succeeded, result, time.process_time() - began))


def _end_with(descriptor: int) -> None:
    """Exit this process when the parent process closes the socket: the parent does not need the result any more."""
    gone = select.poll()
    gone.register(descriptor, select.POLLRDHUP)
    gone.poll()
    os._exit(0)


if __name__ == "__main__":
    _main()
