"""Peers of control beyond the transport: subscribers of command topics, and a node with a leader of its own."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from runtime.core.errors import RuntimeFault
from runtime.core.sentences import Pattern, fixed, series
from runtime.ipc.messages import ALL_SUBSCRIBED, NO_SUBSCRIBER
from runtime.ipc.shared_state import SharedState
from runtime.transports.base import Sink

BEGIN, END = "collect_start", "collect_stop"
_TIMES = 5  # there is no acknowledgement, and the first may be lost during discovery
_APART_S = 0.02


class NodeHandover:
    """Sender of `collect_start` when the robot is yielded to its node, and of `collect_stop` when that ends.

    Args:
        tell: Sends a control word; returns the reason if it could not be sent, else "".
        say: Emits that reason as an event, once per word.
        before: True if an earlier control process died while the robot was yielded, so that `collect_stop` is due.
    """

    def __init__(
        self, tell: Callable[[str, Mapping[str, Any]], str], say: Callable[[str, str], None], before: bool
    ) -> None:
        self._tell, self._say = tell, say
        self._yielded = before
        self._word, self._left, self._last = "", 0, float("-inf")

    @property
    def is_repeating(self) -> bool:
        """Whether the control word will be sent again, because words are repeated against loss."""
        return self._left > 0

    def update(self, yielded: bool, now: float) -> None:
        """Send what is due at this tick; call it at every tick.

        `yielded` is True while the robot is yielded to its node. `now` is the time of the tick [s].
        """
        if yielded is not self._yielded:
            self._yielded = yielded
            self._word, self._left = (BEGIN if yielded else END), _TIMES
            self._refused = ""
        if not self._left or now - self._last < _APART_S:
            return
        self._left, self._last = self._left - 1, now
        refused = self._tell(self._word, {})
        if refused and refused != self._refused:
            self._say("word_refused", refused)
        self._refused = refused


_UNHEARD = Pattern("control.unheard", "{place}: no subscriber")
_HEARD = fixed("control.heard", "all command topics have a subscriber")

_EVERY_S = 2.0
Say = Callable[[str, str, Mapping[str, object]], None]


class SubscriberCheck:
    """Monitor of command topics without a subscriber, which emits an event when the set of these topics changes.

    The event's data lists all of them under `unheard`.
    """

    def __init__(self, shared: SharedState, sink: Sink, say: Say) -> None:
        self._shared_state, self._sink, self._say = shared, sink, say
        self._next = float("-inf")
        self._told: dict[str, str] = {}

    def poll(self, now: float) -> None:
        """Ask the transport for command topics without a subscriber, if a check is due, and emit changes.

        The state is emitted again when the coordinator was restarted.
        """
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
            texts = [reason or _UNHEARD(place=place) for place, reason in sorted(unheard.items())]
            self._say(NO_SUBSCRIBER, series(texts), {"unheard": unheard})
        else:
            self._say(ALL_SUBSCRIBED, _HEARD, {"unheard": {}})
