"""Websocket limits that consumers cannot enforce: pings, endless fragments, and clients that do not read.

Browsers do none of this on their own.
"""

from __future__ import annotations

from typing import Any

from daphne.ws_protocol import WebSocketProtocol
from django.conf import settings

from evaweb.console.flow_control import MessageQuota

PING = 20  # cost of a ping in messages: a burst of 20 pings, 10 per second
_MOST_PARTS = 64  # fragments per message
_READ = 4096  # [bytes] read per socket and turn of the event loop; few messages are longer


class LimitedWebSocket(WebSocketProtocol):  # type: ignore[misc]
    """Daphne's websocket, aborted if it floods with pings or fragments, or does not read."""

    def onConnect(self, request: object) -> object:
        self._quota, self._parts = MessageQuota(), 0
        self.transport.transport.bufferSize = _READ  # of the transport below our wrapper
        return super().onConnect(request)

    def onPing(self, payload: bytes) -> None:
        if self._allowed():
            super().onPing(payload)

    def onPong(self, payload: bytes) -> None:
        if self._allowed():
            super().onPong(payload)

    def onMessageFrameBegin(self, length: int) -> None:
        self._parts += 1
        if self._parts > _MOST_PARTS:
            self._abort(f"a message in more than {_MOST_PARTS} parts")
        else:
            super().onMessageFrameBegin(length)

    def onMessage(self, payload: bytes, isBinary: bool) -> None:
        self._parts = 0
        super().onMessage(payload, isBinary)

    def sendData(self, *given: Any, **named: Any) -> None:
        """Send data, which is buffered here until it is read; abort if too much is unread."""
        super().sendData(*given, **named)
        most = settings.EVA_UNREAD_BYTES
        if unsent(self.transport.transport) > most:
            self._abort(f"more than {most} bytes were not read")

    def _allowed(self) -> bool:
        allowed = self._quota.take(PING)
        if not allowed:
            self._abort("too many pings")
        return allowed

    def _abort(self, reason: str) -> None:
        self.wasNotCleanReason = reason
        self.dropConnection(abort=True)


def unsent(transport: Any) -> int:
    """Return the bytes that a Twisted transport has buffered because the peer does not read.

    Twisted offers no public count, hence the private attributes.
    """
    size: int = len(transport.dataBuffer) - transport.offset + transport._tempDataLen
    return size
