"""When a policy that has failed is asked again, and for how long it is borne with."""

from __future__ import annotations

from collections.abc import Callable

from runtime.core.backoff import BackOff
from runtime.core.clock import Clock
from runtime.core.errors import PolicyLostError, RuntimeFault
from runtime.core.sentences import Pattern

_LOST = Pattern("policy.lost", "{error}; trying again for {seconds:g} s")
_ANSWERS_AGAIN = Pattern("policy.answers_again", "the policy answers again after {seconds:.1f} s")

_LONGEST_S = 0.5  # between two tries: one that is back shortly before patience ends is found in time


class Retry:
    """Failures in a row, from the first to the answer after the last; `say(kind, text)` tells of both."""

    def __init__(self, clock: Clock, patience: float, say: Callable[[str, str], None]) -> None:
        self._clock = clock
        self._patience = patience  # without an answer, until the policy is given up [s]
        self._say = say
        self._back_off = BackOff(longest=_LONGEST_S)
        self.failure = ""  # why the policy is being tried again

    @property
    def lost_for(self) -> float:
        """Time for which the policy has not answered [s], 0 where it does."""
        return self._back_off.failing_for(self._clock.now())

    @property
    def due_in(self) -> float:
        """When it is tried again [s]."""
        return self._back_off.remaining_delay(self._clock.now())

    def record_failure(self, error: RuntimeFault) -> bool:
        """Count a failure; True if the policy will be tried again, False where patience is at its end."""
        first, self.failure = self._back_off.since is None, str(error)
        self._back_off.record_failure(self._clock.now())
        if self.lost_for > self._patience:
            return False
        if first:
            kind = "policy_lost" if isinstance(error, PolicyLostError) else "policy_failed"
            self._say(kind, _LOST(error=error, seconds=self._patience))
        return True

    def record_success(self) -> None:
        """It answers."""
        if self._back_off.since is not None:
            self._say("policy_back", _ANSWERS_AGAIN(seconds=self.lost_for))
        self.reset()

    def reset(self) -> None:
        """Nothing has failed."""
        self._back_off.reset()
        self.failure = ""
