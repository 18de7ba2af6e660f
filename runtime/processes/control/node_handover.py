"""Control's words to a node that drives its robot by a leader of its own: begin, end, each said several times."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

BEGIN, END = "collect_start", "collect_stop"
_TIMES = 5  # nobody acknowledges them, and the first may be lost while a node is found
_APART_S = 0.02


class NodeHandover:
    """Says `collect_start` when the robot is left to its node, `collect_stop` when it is not any more.

    `tell` passes a word on and returns why it could not, "" where it did; `say` is told that once per word. `before`:
    a control that died had left the robot to its node, which is to end.
    """

    def __init__(
        self, tell: Callable[[str, Mapping[str, Any]], str], say: Callable[[str, str], None], before: bool
    ) -> None:
        self._tell, self._say = tell, say
        self._yielded = before
        self._word, self._left, self._last = "", 0, float("-inf")

    @property
    def is_repeating(self) -> bool:
        """True if its word is to be said again."""
        return self._left > 0

    def update(self, yielded: bool, now: float) -> None:
        """One tick at `now` [s]: the robot is the node's, or is not."""
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
