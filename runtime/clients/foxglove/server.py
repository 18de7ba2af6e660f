"""Websocket server of Foxglove's protocol (sub-protocol foxglove.sdk.v1) that only sends.

Messages: text `serverInfo`, `advertise`, `unadvertise`, `status`; binary frames of opcode 1 with subscription (u32),
log time (u64, Unix ns) and payload, little-endian. Clients subscribe and unsubscribe; everything else is refused with
a status. A client that reads slowly gets the newest message of each topic, and of events the newest few.
"""

from __future__ import annotations

import hmac
import http
import json
import logging
import ssl
import struct
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

from websockets.exceptions import ConnectionClosed
from websockets.sync.server import Server, ServerConnection, serve

from runtime.clients.foxglove.topics import EVENTS, Topic
from runtime.clients.listener import limit_sending
from runtime.interop.ros2_messages import schema_name, schema_text

if TYPE_CHECKING:
    from websockets.http11 import Request, Response

log = logging.getLogger(__name__)
PROTOCOL = "foxglove.sdk.v1"
_EVENTS_KEPT = 64
_MOST_CLIENTS = 8
_MOST_SUBSCRIPTIONS = 256  # of a client; a station has some dozens of topics
_MOST_TEXTS = 256  # that wait for a client
_LARGEST = 1 << 16  # [bytes] of what a client sends
_CLOSE_S = 2.0
_HEAD = struct.Struct("<BIQ")
_REFUSED = 2  # level of a status: error


class FoxgloveServer:
    """Server of the present topics; `publish` never waits for a client.

    `token` is required in the address (`?token=`). Pages of a browser connect only from an address in `origins`.
    `on_change` is called, from any thread, when a client subscribes or leaves.
    """

    def __init__(
        self, name: str, token: str, origins: Sequence[str], on_change: Callable[[], None] = lambda: None
    ) -> None:
        self._name, self._token, self._origins = name, token, frozenset(origins)
        self._changed = on_change
        self._lock = threading.Lock()
        self._clients: set[_Client] = set()
        self._channels: dict[str, dict[str, Any]] = {}  # by topic, as advertised
        self._next = 1
        self._server: Server | None = None

    def open(self, host: str, port: int, context: ssl.SSLContext | None = None) -> int:
        """Listen in threads, and return the port. Raises: OSError."""
        self._server = serve(
            self._converse,
            host,
            port,
            ssl=context,
            subprotocols=[PROTOCOL],  # type: ignore[list-item]  # a NewType of str
            process_request=self._admit,
            max_size=_LARGEST,
            compression=None,
            close_timeout=_CLOSE_S,
        )
        threading.Thread(target=self._server.serve_forever, name="foxglove", daemon=True).start()
        return int(self._server.socket.getsockname()[1])

    def advertise(self, topics: Sequence[Topic]) -> None:
        """Replace the topics by these, which other clients than those of the present ones have to subscribe anew."""
        with self._lock:
            before = [channel["id"] for channel in self._channels.values()]
            self._channels = {}
            for topic in topics:
                self._channels[topic.name] = {
                    "id": self._next,
                    "topic": topic.name,
                    "encoding": "cdr",
                    "schemaName": schema_name(topic.kind),
                    "schemaEncoding": "ros2msg",
                    "schema": schema_text(topic.kind),
                }
                self._next += 1
            clients, told = list(self._clients), self._advertisement()
        for client in clients:
            if before:
                client.send_text({"op": "unadvertise", "channelIds": before})
            client.send_text(told)

    @property
    def wanted(self) -> frozenset[str]:
        """Topics that a client has subscribed."""
        with self._lock:
            names = {channel["id"]: topic for topic, channel in self._channels.items()}
            clients = list(self._clients)
        return frozenset(
            names[channel] for client in clients for channel in client.channels() if channel in names
        )

    def publish(self, topic: str, payload: bytes, stamp: int) -> None:
        """Send a message to all who have subscribed its topic."""
        with self._lock:
            channel, clients = self._channels.get(topic), list(self._clients)
        for client in clients if channel is not None else ():
            client.send(channel["id"], payload, stamp, kept=_EVENTS_KEPT if topic == EVENTS else 1)  # type: ignore[index]

    def close(self) -> None:
        """Stop listening and end all connections."""
        if self._server is not None:
            self._server.shutdown()
        with self._lock:
            clients = list(self._clients)
        for client in clients:
            client.end()

    def _advertisement(self) -> dict[str, Any]:
        return {"op": "advertise", "channels": list(self._channels.values())}

    def _admit(self, connection: ServerConnection, request: Request) -> Response | None:
        """Refuse a client without the token, a page of a foreign origin, and too many clients."""
        given = parse_qs(urlsplit(request.path).query).get("token", [""])[0]
        if not hmac.compare_digest(given.encode(), self._token.encode()):
            return connection.respond(
                http.HTTPStatus.UNAUTHORIZED, "the address needs ?token=..., see the bridge's log\n"
            )
        origin = request.headers.get("Origin")
        if origin is not None and origin not in self._origins:
            log.warning("a page of %.200s was refused: --origin would allow it", origin)
            return connection.respond(
                http.HTTPStatus.FORBIDDEN, "pages of this origin are not allowed: --origin\n"
            )
        with self._lock:
            full = len(self._clients) >= _MOST_CLIENTS
        if full:
            return connection.respond(
                http.HTTPStatus.SERVICE_UNAVAILABLE, f"{_MOST_CLIENTS} clients are connected\n"
            )
        return None

    def _converse(self, connection: ServerConnection) -> None:
        limit_sending(connection.socket)
        client = _Client(connection)
        info = {"op": "serverInfo", "name": self._name, "capabilities": [], "metadata": {}, "sessionId": ""}
        with self._lock:
            self._clients.add(client)
            told = self._advertisement()
        client.send_text(info)
        if told["channels"]:
            client.send_text(told)
        try:
            for message in connection:
                client.on_message(message)
                self._changed()
        except ConnectionClosed:
            pass
        finally:
            with self._lock:
                self._clients.discard(client)
            client.end()
            self._changed()


class _Client:
    """One connection: its subscriptions, and what waits to be sent to it, by a thread of its own."""

    def __init__(self, connection: ServerConnection) -> None:
        self._connection = connection
        self._ready = threading.Condition()
        self._texts: deque[str] = deque()
        self._subscribed: dict[int, int] = {}  # channel by subscription
        self._waiting: dict[int, deque[bytes]] = {}  # frames by subscription, the longest waiting first
        self._ended = False
        threading.Thread(target=self._send_waiting, name="foxglove-send", daemon=True).start()

    def channels(self) -> frozenset[int]:
        with self._ready:
            return frozenset(self._subscribed.values())

    def send_text(self, message: Mapping[str, Any]) -> None:
        with self._ready:
            self._texts.append(json.dumps(message))
            self._ended |= len(self._texts) > _MOST_TEXTS  # it does not read
            if message.get("op") == "unadvertise":
                self._subscribed.clear()
                self._waiting.clear()
            self._ready.notify()

    def send(self, channel: int, payload: bytes, stamp: int, kept: int) -> None:
        with self._ready:
            for subscription, subscribed in self._subscribed.items():
                if subscribed == channel:
                    frames = self._waiting.setdefault(subscription, deque(maxlen=kept))
                    frames.append(_HEAD.pack(1, subscription, stamp) + payload)
                    self._ready.notify()

    def on_message(self, message: str | bytes) -> None:
        """Subscribe or unsubscribe; anything else is refused: this server only sends."""
        try:
            asked = json.loads(message) if isinstance(message, str) else {}
            operation = asked.get("op")
            if operation == "subscribe":
                chosen = {int(row["id"]): int(row["channelId"]) for row in asked["subscriptions"]}
                if not all(0 <= number < 1 << 32 for number in chosen):
                    raise ValueError("a subscription's id is a u32")
                with self._ready:
                    held = {channel: number for number, channel in self._subscribed.items()}
                    held |= {channel: number for number, channel in chosen.items()}  # one per channel
                    if len(held) > _MOST_SUBSCRIPTIONS:
                        raise ValueError(f"at most {_MOST_SUBSCRIPTIONS} subscriptions")
                    self._subscribed = {number: channel for channel, number in held.items()}
                    for number in [one for one in self._waiting if one not in self._subscribed]:
                        del self._waiting[number]
                return
            if operation == "unsubscribe":
                ended = [int(number) for number in asked["subscriptionIds"]]
                with self._ready:
                    for number in ended:
                        self._subscribed.pop(number, None)
                        self._waiting.pop(number, None)
                return
            text = f"{operation or 'a binary message'!s:.40}: this server only shows; allowed: subscribe, unsubscribe"
        except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError) as error:
            text = f"the message cannot be read: {error!s:.200}"
        self.send_text({"op": "status", "level": _REFUSED, "message": text})

    def end(self) -> None:
        with self._ready:
            self._ended = True
            self._ready.notify()

    def _send_waiting(self) -> None:
        with suppress(ConnectionClosed, OSError):
            while (frame := self._next_frame()) is not None:
                self._connection.send(frame)
        self._connection.close()

    def _next_frame(self) -> str | bytes | None:
        """Return what is sent next, waiting for it; None at the end. The topic that waits longest comes first."""
        with self._ready:
            while not (self._ended or self._texts or self._waiting):
                self._ready.wait()
            if self._ended:
                return None
            if self._texts:
                return self._texts.popleft()
            subscription = next(iter(self._waiting))
            frames = self._waiting.pop(subscription)
            frame = frames.popleft()
            if frames:
                self._waiting[subscription] = frames
            return frame
