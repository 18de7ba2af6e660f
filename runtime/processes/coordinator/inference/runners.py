"""Runners of blocking policy calls: in a thread, or in lockstep."""

from __future__ import annotations

import logging
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

from runtime.core.errors import PolicyError, RuntimeFault
from runtime.core.sentences import fixed

log = logging.getLogger(__name__)
_CODE_FAILED = fixed("policy.code_failed", "the policy's own code failed")
Result = TypeVar("Result")
Declared = Callable[[Any], tuple[Any, int]]
"""Maps what a call returned to the result to return, and the delay of that result [ticks]."""


class Runner(ABC):
    """Executor of blocking calls to the policy, one after the other."""

    @abstractmethod
    def submit(self, call: Callable[[], Result]) -> Future[Result]:
        """Start `call`, and return its future.

        When `ready` returns True, the future contains the result, or the RuntimeFault that the call raised.
        """

    @abstractmethod
    def ready(self, future: Future[Result]) -> bool: ...

    @abstractmethod
    def run_in_background(self, call: Callable[[], Result]) -> Future[Result]:
        """Start `call`, which does not use the policy, without waiting for earlier calls."""

    @property
    @abstractmethod
    def busy(self) -> bool:
        """Whether an earlier call is still running, so that another would wait."""

    def tick(self) -> None:  # noqa: B027  # only runners that count have something to do
        """Advance by one control period."""

    def close(self) -> None:  # noqa: B027  # only runners with a thread have something to do
        """Accept no further calls."""


@contextmanager
def as_policy_errors(what: str) -> Iterator[None]:
    """Convert exceptions within the context to a PolicyError that begins with `what`, and log the traceback.

    A RuntimeFault is not converted. The coordinator handles both kinds, so that no response of a policy can end it.
    """
    try:
        yield
    except RuntimeFault:
        raise
    except Exception as error:
        log.exception(what)
        raise PolicyError(f"{what}: {type(error).__name__}: {error}") from error


def _call_logged(call: Callable[[], Result]) -> Callable[[], Result]:
    def told() -> Result:
        with as_policy_errors(_CODE_FAILED):
            return call()

    return told


def _settle(future: Future[Result], call: Callable[[], Result]) -> None:
    try:
        future.set_result(call())
    except Exception as error:
        future.set_exception(error)


class ThreadRunner(Runner):
    """Runner with one thread, so that a slow policy never blocks the coordinator."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="policy")
        self._newest: Future[Any] | None = None

    def submit(self, call: Callable[[], Result]) -> Future[Result]:
        future = self._pool.submit(_call_logged(call))
        self._newest = future
        return future

    def run_in_background(self, call: Callable[[], Result]) -> Future[Result]:
        future: Future[Result] = Future()
        # A daemon: preparation must not prevent the end of the process.
        threading.Thread(target=_settle, args=(future, call), name="aside", daemon=True).start()
        return future

    def ready(self, future: Future[Result]) -> bool:
        return future.done()

    @property
    def busy(self) -> bool:
        return self._newest is not None and not self._newest.done()

    def close(self) -> None:
        self._pool.shutdown(wait=False, cancel_futures=True)


class DeclaredRunner(Runner):
    """Runner that executes calls between two ticks; a call's result is ready after a declared number of ticks.

    The function `declared` receives what a call returned. It returns the result of the call, and the number of ticks
    after which that result is ready, `least` at least. Calls start at `start_waiting`. They run on a thread, so that
    the ticking thread can answer commands meanwhile; no tick may pass while a call is running. Therefore the step at
    which a result is ready does not depend on the call's real duration.
    """

    def __init__(self, declared: Declared, least: int = 1) -> None:
        self._declared, self._least = declared, least
        self._thread = ThreadRunner()
        self._now = 0
        self._waiting: deque[tuple[Future[Any], Callable[[], Any]]] = deque()
        self._asked: WeakKeyDictionary[Future[Any], int] = WeakKeyDictionary()
        self._late: WeakKeyDictionary[Future[Any], int] = WeakKeyDictionary()

    def submit(self, call: Callable[[], Result]) -> Future[Result]:
        future: Future[Result] = Future()
        self._asked[future] = self._now
        self._waiting.append((future, call))
        return future

    def run_in_background(self, call: Callable[[], Result]) -> Future[Result]:
        future: Future[Result] = Future()
        _settle(future, call)
        return future

    def start_waiting(self) -> bool:
        """Start all calls that were submitted and not started yet; return True while a call is running."""
        while self._waiting:
            self._thread.submit(partial(self._make, *self._waiting.popleft()))
        return self._thread.busy

    def ready(self, future: Future[Result]) -> bool:
        # With `least` 1 never in the tick of the request: the number of polls within a tick is random.
        late = max(self._least, self._late.get(future, self._least))
        return future.done() and self._now >= self._asked[future] + late

    @property
    def busy(self) -> bool:
        return bool(self._waiting) or self._thread.busy

    def tick(self) -> None:
        self._now += 1

    def close(self) -> None:
        self._thread.close()

    def _make(self, future: Future[Any], call: Callable[[], Any]) -> None:
        def handed_over() -> Any:
            result, self._late[future] = self._declared(_call_logged(call)())
            return result

        _settle(future, handed_over)


class LockstepRunner(Runner):
    """Runner that calls at once; the result is ready `delay` ticks later, the same on every run.

    `delay` is a number of ticks, or `declared` as of a DeclaredRunner.
    """

    def __init__(self, delay: int | Declared) -> None:
        self._delay = delay
        self._now = 0
        self._due: WeakKeyDictionary[Future[Any], int] = WeakKeyDictionary()

    def submit(self, call: Callable[[], Result]) -> Future[Result]:
        future: Future[Result] = Future()
        ticks = self._delay if isinstance(self._delay, int) else 0
        try:
            result = _call_logged(call)()
            if callable(self._delay):
                result, ticks = self._delay(result)
            future.set_result(result)
        except RuntimeFault as error:
            future.set_exception(error)
        self._due[future] = self._now + ticks
        return future

    def run_in_background(self, call: Callable[[], Result]) -> Future[Result]:
        future: Future[Result] = Future()
        _settle(future, call)
        return future

    def ready(self, future: Future[Result]) -> bool:
        return self._now >= self._due[future]

    @property
    def busy(self) -> bool:
        return False

    def tick(self) -> None:
        self._now += 1
