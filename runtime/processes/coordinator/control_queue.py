"""Coordinator's end of the ring to control: numbered orders and chunks."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from runtime.core.errors import RuntimeFault
from runtime.core.sentences import fixed
from runtime.core.types import ControlSource, Float64
from runtime.ipc.messages import (
    LockGrippers,
    Message,
    Mode,
    NodeRequest,
    Order,
    OrderKind,
    PolicyAway,
    PostedChunk,
    Tune,
    encode,
)
from runtime.ipc.shared_state import SharedState

log = logging.getLogger(__name__)
_CONTROL_DOES_NOT_READ = fixed(
    "orders.control_does_not_read",
    "control does not read its orders: the ring is full; restart the station",
)


class ControlQueue:
    """Sender of orders and chunks; only the thread of the coordinator's loop may call it."""

    def __init__(self, shared: SharedState) -> None:
        self._shared_state = shared
        self._number = int(shared.control.read()["order"])
        self._chunk = 0

    def send_order(
        self,
        kind: OrderKind,
        *,
        run: int = 0,
        goal: Float64 | None = None,
        reason: str = "",
        mode: Mode = "continuous",
        source: ControlSource = "policy",
        speed: float = 1.0,
    ) -> int:
        """Send an order; return its number, which appears in control's status once control obeys the order.

        An order that control does not read is lost, and that is logged.

        Args:
            kind: Kind of the order.
            run: Number of the open run; 0 if there is none.
            goal: End of a motion [D]; NaN for dimensions that stay where they stop. None for other orders.
            reason: Why the order is sent.
            mode: Mode of the run that control is to follow.
            source: What drives the robot in that run.
            speed: Share of the speed of generated motions that a motion may use.
        """
        self._number += 1
        try:
            self._push(Order(self._number, kind, run, goal, reason, mode, source, speed))
        except RuntimeFault as error:
            log.error("order %s is lost: %s", kind, error)  # the health monitor detects a control that hangs
        return self._number

    def next_chunk(self) -> int:
        """Return a new chunk number."""
        self._chunk += 1
        return self._chunk

    def send_chunk(self, chunk: PostedChunk) -> None:
        """Send a chunk, which control merges."""
        self._push(chunk)

    def tune(self, strategy: Mapping[str, Any]) -> None:
        """Change the strategy with which control merges, from its next tick on."""
        self._push(Tune(strategy))

    def bear(self, run: int, until: float) -> None:
        """Let control wait instead of hold if nothing is planned before `until` [s, monotonic clock]."""
        self._push(PolicyAway(run, until))

    def lock_grippers(self, values: Float64) -> None:
        """Lock grippers at these values [D]; NaN: unlocked."""
        self._push(LockGrippers(values))

    def send_node_request(self, word: str, data: Mapping[str, Any]) -> None:
        """Send a control word to the node, through control."""
        self._push(NodeRequest(word, data))

    def _push(self, message: Message) -> None:
        if not self._shared_state.rings["orders"].push(encode(message)):
            raise RuntimeFault(_CONTROL_DOES_NOT_READ)
