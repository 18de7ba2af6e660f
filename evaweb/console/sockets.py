"""Websockets that say too much below the messages which consumers count: pings, and messages in endless parts.

Browsers send neither of themselves.
"""

from __future__ import annotations

from daphne.ws_protocol import WebSocketProtocol

from evaweb.console.quota import Quota

PING = 20  # messages that a ping counts as: 20 at once, 10 a second
_MOST_PARTS = 64  # of one message
_READ = 4096  # bytes of one socket in one turn of the loop; a message is longer seldom


class CountedSocket(WebSocketProtocol):  # type: ignore[misc]
    """A websocket of daphne's that is cut off where it pings or divides without end."""

    def onConnect(self, request: object) -> object:
        self._quota, self._parts = Quota(), 0
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
            self._cut(f"a message in more than {_MOST_PARTS} parts")
        else:
            super().onMessageFrameBegin(length)

    def onMessage(self, payload: bytes, isBinary: bool) -> None:
        self._parts = 0
        super().onMessage(payload, isBinary)

    def _allowed(self) -> bool:
        allowed = self._quota.take(PING)
        if not allowed:
            self._cut("too many pings")
        return allowed

    def _cut(self, why: str) -> None:
        self.wasNotCleanReason = why
        self.dropConnection(abort=True)
