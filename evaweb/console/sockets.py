"""Websockets beyond what consumers count: pings, messages in endless parts, and clients that do not read.

Browsers do none of that of themselves.
"""

from __future__ import annotations

from typing import Any

from daphne.ws_protocol import WebSocketProtocol
from django.conf import settings

from evaweb.console.quota import MessageQuota

PING = 20  # messages that a ping counts as: 20 at once, 10 a second
_MOST_PARTS = 64  # of one message
_READ = 4096  # bytes of one socket in one turn of the loop; a message is longer seldom


class LimitedWebSocket(WebSocketProtocol):  # type: ignore[misc]
    """A websocket of daphne's that is cut off where it pings or divides without end, or does not read."""

    def onConnect(self, request: object) -> object:
        self._quota, self._parts = MessageQuota(), 0
        self.transport.transport.bufferSize = _READ  # our wrapper's
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
        """Whatever it is sent, which stays here until it is read."""
        super().sendData(*given, **named)
        most = settings.EVA_UNREAD_BYTES
        if unsent(self.transport.transport) > most:
            self._abort(f"more than {most} bytes were not read")

    def _allowed(self) -> bool:
        allowed = self._quota.take(PING)
        if not allowed:
            self._abort("too many pings")
        return allowed

    def _abort(self, why: str) -> None:
        self.wasNotCleanReason = why
        self.dropConnection(abort=True)


def unsent(transport: Any) -> int:
    """What a transport of Twisted's still holds because the other end does not read [bytes]; it counts for itself."""
    held: int = len(transport.dataBuffer) - transport.offset + transport._tempDataLen
    return held
