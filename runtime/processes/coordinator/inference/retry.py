"""Retries of a failed policy: back-off, and a limit of time."""

from __future__ import annotations

from collections.abc import Callable

from runtime.core.backoff import BackOff
from runtime.core.clock import Clock
from runtime.core.errors import PolicyLostError, RuntimeFault
from runtime.core.sentences import Pattern

_LOST = Pattern("policy.lost", "{error}; trying again for {seconds:g} s")
_ANSWERS_AGAIN = Pattern("policy.answers_again", "the policy answers again after {seconds:.1f} s")

_LONGEST_S = 0.5  # [s] between two attempts: finds a policy that returns just before the limit


class Retry:
    """Consecutive failures of a policy, with growing delays between retries.

    `patience` [s] is the time without a response after which the policy is given up. `say` is called with the kind and
    text of an event at the first failure and at the recovery.
    """

    def __init__(self, clock: Clock, patience: float, say: Callable[[str, str], None]) -> None:
        self._clock = clock
        self._patience = patience  # without a response, until the policy is given up [s]
        self._say = say
        self._back_off = BackOff(longest=_LONGEST_S)
        self.failure = ""  # why the policy is being retried

    @property
    def lost_for(self) -> float:
        """Time since the first of the consecutive failures [s], 0 if there is none."""
        return self._back_off.failing_for(self._clock.now())

    @property
    def due_in(self) -> float:
        """Time until the next attempt [s]."""
        return self._back_off.remaining_delay(self._clock.now())

    def record_failure(self, error: RuntimeFault) -> bool:
        """Record a failure; return True if the policy will be retried, False if the time for retries is over."""
        first, self.failure = self._back_off.since is None, str(error)
        self._back_off.record_failure(self._clock.now())
        if self.lost_for > self._patience:
            return False
        if first:
            kind = "policy_lost" if isinstance(error, PolicyLostError) else "policy_failed"
            self._say(kind, _LOST(error=error, seconds=self._patience))
        return True

    def record_success(self) -> None:
        """Record a response, and report the recovery if there were failures."""
        if self._back_off.since is not None:
            self._say("policy_back", _ANSWERS_AGAIN(seconds=self.lost_for))
        self.reset()

    def reset(self) -> None:
        """Clear all failures."""
        self._back_off.reset()
        self.failure = ""
