"""Back-pressure for streamed answers: pieces are produced no faster than the client reads them.

Daphne buffers everything that it is given: an unread download would be held in memory completely.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable
from typing import Any

from evaweb.console.websocket_limits import unsent

AHEAD = 256 * 1024  # [bytes] unread part of an answer below which the next piece is produced
STALLED_S = 30.0  # time without a byte read after which the connection is aborted
_LOOK_S = 0.05


async def until_read(
    request: Any,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], Awaitable[None]] = asyncio.sleep,
) -> None:
    """Wait until at most `AHEAD` bytes of the answer are unread, or the connection is closed."""
    least, since = None, clock()
    while (channel := request.channel) is not None:
        wire = channel.transport.transport  # the transport below our wrapper
        pending = unsent(wire)
        if pending <= AHEAD:
            return
        if least is None or pending < least:
            least, since = pending, clock()
        elif clock() - since > STALLED_S:
            wire.abortConnection()
            return
        await sleep(_LOOK_S)
