"""Control words to a node with its own leader: begin and end, each sent several times."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

BEGIN, END = "collect_start", "collect_stop"
_TIMES = 5  # there is no acknowledgement, and the first may be lost during discovery
_APART_S = 0.02


class NodeHandover:
    """Sender of `collect_start` when the robot is yielded to its node, and `collect_stop` when that ends.

    `tell` sends a word and returns why it could not, "" if it did; `say` emits that reason, once per word. `before`:
    an earlier control process died while the robot was yielded, which must end.
    """

    def __init__(
        self, tell: Callable[[str, Mapping[str, Any]], str], say: Callable[[str, str], None], before: bool
    ) -> None:
        self._tell, self._say = tell, say
        self._yielded = before
        self._word, self._left, self._last = "", 0, float("-inf")

    @property
    def is_repeating(self) -> bool:
        """Whether the word must be sent again."""
        return self._left > 0

    def update(self, yielded: bool, now: float) -> None:
        """Update at each tick `now` [s]: `yielded` is whether the robot is node-driven."""
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
