"""Answers that are made piece by piece are made no faster than the other end reads them.

Daphne hands on whatever it is given: of a download that nobody reads all of it would lie in memory.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable
from typing import Any

from evaweb.console.sockets import unsent

AHEAD = 256 * 1024  # bytes of an answer that may be unread when its next piece is made
STALLED_S = 30.0  # without a byte read, after which the connection is cut off
_LOOK_S = 0.05


async def until_read(
    request: Any,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], Awaitable[None]] = asyncio.sleep,
) -> None:
    """Wait until at most `AHEAD` of what a request of daphne's was answered is unread, or its connection is gone."""
    least, since = None, clock()
    while (channel := request.channel) is not None:
        wire = channel.transport.transport  # our wrapper's
        held = unsent(wire)
        if held <= AHEAD:
            return
        if least is None or held < least:
            least, since = held, clock()
        elif clock() - since > STALLED_S:
            wire.abortConnection()
            return
        await sleep(_LOOK_S)
