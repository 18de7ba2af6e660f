"""The coordinator's side of the ring to control: numbered orders and chunks."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from runtime.core.errors import RuntimeFault
from runtime.core.sentences import fixed
from runtime.core.types import Float64
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
    """Writes orders and chunks; only the thread that owns the coordinator's loop may call it."""

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
        speed: float = 1.0,
    ) -> int:
        """Tell control what to do; returns the order's number, which control's status shows once obeyed."""
        self._number += 1
        try:
            self._push(Order(self._number, kind, run, goal, reason, mode, speed))
        except RuntimeFault as error:
            log.error(
                "order %s is lost: %s", kind, error
            )  # the coordinator goes on: it notices that control hangs
        return self._number

    def is_obeyed(self, number: int) -> bool:
        """True if control has come to order `number`."""
        return int(self._shared_state.control.read()["order"]) >= number

    def next_chunk(self) -> int:
        """A new chunk number."""
        self._chunk += 1
        return self._chunk

    def send_chunk(self, chunk: PostedChunk) -> None:
        """Hand a chunk over, unmerged."""
        self._push(chunk)

    def tune(self, strategy: Mapping[str, Any]) -> None:
        """Have control merge by another strategy, or other parameters of it, from its next tick on."""
        self._push(Tune(strategy))

    def bear(self, run: int, until: float) -> None:
        """Have control stand, and not hold, where nothing is planned before `until` on the monotonic clock [s]."""
        self._push(PolicyAway(run, until))

    def lock_grippers(self, values: Float64) -> None:
        """Lock grippers at these values [D]; NaN for what is not locked."""
        self._push(LockGrippers(values))

    def send_node_request(self, word: str, data: Mapping[str, Any]) -> None:
        """Have control pass a control word on to the node."""
        self._push(NodeRequest(word, data))

    def _push(self, message: Message) -> None:
        if not self._shared_state.rings["orders"].push(encode(message)):
            raise RuntimeFault(_CONTROL_DOES_NOT_READ)
