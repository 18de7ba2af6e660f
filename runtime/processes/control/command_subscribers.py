"""Check for subscribers of command topics, as far as a transport knows them."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from runtime.core.errors import RuntimeFault
from runtime.core.sentences import Pattern, fixed, series
from runtime.ipc.messages import ALL_SUBSCRIBED, NO_SUBSCRIBER
from runtime.ipc.shared_state import SharedState
from runtime.transports.base import Sink

_UNHEARD = Pattern("control.unheard", "nobody listens to {place}")
_HEARD = fixed("control.heard", "all commands are heard")

_EVERY_S = 2.0
Say = Callable[[str, str, Mapping[str, object]], None]


class SubscriberCheck:
    """Monitor of command topics without a subscriber: emits an event when they change.

    The event's data lists all of them under `unheard`.
    """

    def __init__(self, shared: SharedState, sink: Sink, say: Say) -> None:
        self._shared_state, self._sink, self._say = shared, sink, say
        self._next = float("-inf")
        self._told: dict[str, str] = {}

    def poll(self, now: float) -> None:
        """Check, if due; the state is reported again to a restarted coordinator."""
        if self._shared_state.last_beat("coordinator") == 0.0:
            self._told, self._next = {}, now
            return
        if now < self._next:
            return
        self._next = now + _EVERY_S
        try:
            unheard = self._sink.missing_subscribers()
        except RuntimeFault as error:  # commands are sent all the same
            unheard = {"": str(error)}
        if unheard == self._told:
            return
        self._told = unheard
        if unheard:
            said = [why or _UNHEARD(place=place) for place, why in sorted(unheard.items())]
            self._say(NO_SUBSCRIBER, series(said), {"unheard": unheard})
        else:
            self._say(ALL_SUBSCRIBED, _HEARD, {"unheard": {}})
