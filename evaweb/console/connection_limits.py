"""Limits for connections that have not sent a whole request yet, or wait for their next one.

If there are too many, the oldest are closed, never the newest: a client that sends its request at once is served,
however many idle connections come from the same address.
"""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import daphne.server  # noqa: F401  first: it decides which reactor there is

# isort: split
from twisted.internet import reactor
from twisted.internet.interfaces import IAddress
from twisted.protocols.policies import ProtocolWrapper, WrappingFactory

from evaweb.console.body_limits import BoundedRequest, stop_bound_of
from evaweb.console.early_refusals import Channel, is_stop
from evaweb.console.flow_control import TurnScheduler

events: Any = reactor
WHOLE_REQUEST_S = 15.0  # limit for the first request of a connection
NEXT_REQUEST_S = 75.0  # limit for each further request; Twisted itself closes an idle connection after 60 s


@dataclass(frozen=True, slots=True)
class _Waiting:
    peer: str
    until: float
    close: Callable[[], object]


class ConnectionLimiter:
    """Limiter of waiting connections: at most `most` in all, and `most_of_one` per address. For the event loop only."""

    def __init__(self, most: int, most_of_one: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._most, self._most_of_one, self._clock = most, most_of_one, clock
        self._all: OrderedDict[int, _Waiting] = OrderedDict()  # oldest first
        self._of: dict[str, OrderedDict[int, None]] = {}

    def __len__(self) -> int:
        return len(self._all)

    def add(self, key: int, peer: str, seconds: float, close: Callable[[], object]) -> None:
        """Add a connection that may wait for `seconds` [s]; `close` ends it. The oldest are closed if a limit
        is exceeded.
        """
        self.remove(key)
        self._all[key] = _Waiting(peer, self._clock() + seconds, close)
        of_one = self._of.setdefault(peer, OrderedDict())
        of_one[key] = None
        if len(of_one) > self._most_of_one:
            self._end(next(iter(of_one)))
        elif len(self._all) > self._most:
            self._end(next(iter(self._all)))

    def remove(self, key: int) -> None:
        """Remove a connection that has sent a request or was closed."""
        connection = self._all.pop(key, None)
        if connection is None:
            return
        of_one = self._of[connection.peer]
        del of_one[key]
        if not of_one:
            del self._of[connection.peer]

    def close_expired(self) -> None:
        """Close the connections whose time is up."""
        now = self._clock()
        for key in [key for key, waiting in self._all.items() if waiting.until <= now]:
            self._end(key)

    def _end(self, key: int) -> None:
        close = self._all[key].close
        self.remove(key)
        close()


class Request(BoundedRequest):
    """Request that tells its connection when the connection's limit has to end and to begin again.

    The limit ends when the request is complete, or is admitted so that its body may take longer. It begins again when
    the request has been answered.
    """

    def admitted(self) -> None:
        self.channel.transport.sent()

    def process(self) -> None:
        """Pass the complete request to the application: a stop at once, any other in its turn of the event loop."""
        self.channel.transport.sent()
        if is_stop(self.path):
            super().process()
        else:
            self.channel.transport.factory.turns.submit(self._in_turn)

    def _in_turn(self) -> None:
        if not self._disconnected:
            super().process()

    def finish(self) -> None:
        if self.channel is not None:
            self.channel.transport.answered()
        super().finish()


class StopRequest(Request):
    """Request to the process for stops, which accepts neither long bodies nor websockets."""

    bound_of = staticmethod(stop_bound_of)

    def process(self) -> None:
        self.requestHeaders.removeHeader(b"upgrade")
        super().process()


class _Connection(ProtocolWrapper):
    def connectionMade(self) -> None:
        self._wait(WHOLE_REQUEST_S, self.transport.abortConnection)
        super().connectionMade()

    def connectionLost(self, reason: object) -> None:
        self.factory.arrivals.remove(id(self))
        super().connectionLost(reason)

    def sent(self) -> None:
        """Stop limiting the connection: a whole request has arrived, or its sender is known."""
        self.factory.arrivals.remove(id(self))

    def answered(self) -> None:
        """Limit the connection again while it waits for its next request."""
        self._wait(NEXT_REQUEST_S, self.transport.loseConnection)

    def _wait(self, seconds: float, close: Callable[[], object]) -> None:
        self.factory.arrivals.add(id(self), str(getattr(self.getPeer(), "host", "")), seconds, close)


class LimitedFactory(WrappingFactory):
    """Factory of Daphne's connections; each waiting connection is registered with the limiter `arrivals`."""

    protocol = _Connection
    noisy = False

    def __init__(self, factory: Any, arrivals: ConnectionLimiter, request: type[Request] = Request) -> None:
        super().__init__(factory)
        factory.protocol = Channel
        self.arrivals, self._request = arrivals, request
        self.turns = TurnScheduler(partial(events.callLater, 0))

    def buildProtocol(self, addr: IAddress) -> ProtocolWrapper:
        protocol = super().buildProtocol(addr)
        protocol.wrappedProtocol.requestFactory = self._request
        return protocol
