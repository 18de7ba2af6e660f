"""Runners of blocking calls to a policy: a thread beside the coordinator, or counted out in lockstep."""

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


class Runner(ABC):
    """Makes blocking calls to the policy, one after the other."""

    @abstractmethod
    def submit(self, call: Callable[[], Result]) -> Future[Result]:
        """Start `call`; its result or RuntimeFault is in the future when `ready` says so."""

    @abstractmethod
    def ready(self, future: Future[Result]) -> bool: ...

    @abstractmethod
    def run_in_background(self, call: Callable[[], Result]) -> Future[Result]:
        """Start `call`, which has nothing to do with the policy, behind no other."""

    @property
    @abstractmethod
    def busy(self) -> bool:
        """True while an earlier call is still being made, and another would wait behind it."""

    def tick(self) -> None:  # noqa: B027  # only runners that count have something to do
        """One control period has passed."""

    def close(self) -> None:  # noqa: B027  # only runners with a thread have something to do
        """Take no further calls."""


@contextmanager
def as_policy_errors(what: str) -> Iterator[None]:
    """Tell every error within as a PolicyError, its traceback in the log: no answer ends the coordinator."""
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
    """One thread of its own, so that a slow policy never stops the coordinator."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="policy")
        self._newest: Future[Any] | None = None

    def submit(self, call: Callable[[], Result]) -> Future[Result]:
        future = self._pool.submit(_call_logged(call))
        self._newest = future
        return future

    def run_in_background(self, call: Callable[[], Result]) -> Future[Result]:
        future: Future[Result] = Future()
        # A daemon: what is only being prepared keeps no process from ending.
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
    """Makes calls between two ticks, and hands each result over as many ticks later as `declared` says of it.

    Calls wait for `begin`. They are made on a thread, so that who ticks can answer commands meanwhile; as long as one
    is being made, no time may pass. So what is handed over when does not depend on how long a call really took.
    """

    def __init__(self, declared: Callable[[Any], tuple[Any, int]]) -> None:
        self._declared = declared  # from a result to what is handed over, and its delay [ticks]
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
        """Begin all calls that wait; whether one is being made now."""
        while self._waiting:
            self._thread.submit(partial(self._make, *self._waiting.popleft()))
        return self._thread.busy

    def ready(self, future: Future[Result]) -> bool:
        # Never within the tick of the question: how often the coordinator looks in that time is chance.
        return future.done() and self._now >= self._asked[future] + max(1, self._late.get(future, 1))

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
    """Calls at once and hands the result over `delay` ticks later, the same on every run."""

    def __init__(self, delay: int) -> None:
        self._delay = delay
        self._now = 0
        self._due: WeakKeyDictionary[Future[Any], int] = WeakKeyDictionary()

    def submit(self, call: Callable[[], Result]) -> Future[Result]:
        future: Future[Result] = Future()
        try:
            future.set_result(_call_logged(call)())
        except RuntimeFault as error:
            future.set_exception(error)
        self._due[future] = self._now + self._delay
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
