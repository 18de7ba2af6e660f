"""Streams of linked stations, at the lab's end of the link.

The lab publishes the streams of a linked station as a station publishes its own. It requests a stream from the station
while the stream has subscribers at the lab.

The second port has its own thread and ZMQ context, so that pictures delay no command. A station sends as many bundles
as it has credit for; each bundle passed on renews its credit. Episodes arrive here too, for `incoming.py`.
"""

from __future__ import annotations

import logging
import re
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

import zmq

from runtime.core.errors import TransportError
from runtime.ipc.bus import CAMERA_HIGH_WATER, STREAM_HIGH_WATER, Publisher
from runtime.link.admission import AllowList
from runtime.link.door import Arrival, Door
from runtime.link.incoming import Incoming
from runtime.link.key_files import KeyPair
from runtime.link.release import version
from runtime.link.wire import (
    EPISODES,
    LARGEST_PICTURE,
    PICTURES,
    RELEASE,
    STATE,
    Beat,
    Bundle,
    Credit,
    Hello,
    Labels,
    Offer,
    Piece,
    Want,
    Welcome,
    apart,
)

log = logging.getLogger(__name__)
RATE = 64e6  # greatest rate of one connection [bytes/s]
_POLL_MS = 50
_WINDOW = {STATE: 4, PICTURES: 2}  # bundles in transit
_SLACK = 16  # bundles tolerated beyond the credit, because our count may lag behind the station's
_NAMES = {STATE: re.compile(r"[a-z_]{1,40}"), PICTURES: re.compile(r"camera/[A-Za-z0-9_.-]{1,80}")}
_MOST_TOPICS = 32
_MOST_OFFERED = 4  # unanswered offers of episodes and labels per station
_SOON_S = 0.5  # [s], until a station tries again that the first port may not have admitted yet


@dataclass(slots=True)
class _Flow:
    """Stream socket of one station, and the connection that feeds it; `route` is b"" if there is none."""

    published: Publisher
    role: str
    route: bytes = b""
    credit: int = 0
    asked: list[str] = field(default_factory=list)


@dataclass(slots=True)
class _Sender:
    """Connection over which a station sends episodes, with the numbers of pieces and offers that it may still send."""

    station: str
    asked: int = 0
    offered: int = 0

    def may_send(self, message: Offer | Labels | Piece) -> bool:
        """Count the message; return False if the station sends more messages of its kind than the protocol allows."""
        if isinstance(message, Piece):
            self.asked -= 1
            return self.asked >= 0
        self.asked = 0  # pieces requested before an offer do not arrive any more
        self.offered += 1
        return self.offered <= _MOST_OFFERED


class LabStreams:
    """Second port of a lab; without `incoming` no station can send episodes."""

    def __init__(
        self,
        host: str,
        port: int,
        key: KeyPair,
        allowed: AllowList,
        clock: Callable[[], float] = time.monotonic,
        incoming: Incoming | None = None,
    ) -> None:
        self.context: zmq.Context[Any] = zmq.Context()
        self._incoming = incoming
        self._senders: dict[bytes, _Sender] = {}
        self._where = (host, port, key)
        self._allowed, self._clock = allowed, clock
        self._orders: SimpleQueue[tuple[str, Path | None]] = SimpleQueue()
        self._flows: dict[tuple[str, str], _Flow] = {}
        self._by_route: dict[bytes, _Flow] = {}
        self.places: dict[str, tuple[str, str]] = {}  # by station: endpoints of its state and its pictures
        self.failed = False  # after an unforeseen error: the gate then ends and is restarted
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._work, name="streams", daemon=True)

    def open(self) -> int:
        """Listen at the port and return its number; call it after admission has started. Raises: TransportError."""
        host, port, key = self._where
        largest = LARGEST_PICTURE
        self._door = Door(self.context, host, port, key, largest, RATE, self._allowed, self._clock)
        return self._door.port

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def end(self) -> None:
        """Stop the thread; no stream is published any more."""
        self._ended.set()
        self._thread.join()

    def serve(self, station: str, station_dir: Path) -> None:
        """Publish the streams of a station in the folder `station_dir`; any thread may call it."""
        self._orders.put((station, station_dir))

    def leave(self, station: str) -> None:
        """Stop publishing the streams of a station; any thread may call it."""
        self.places.pop(station, None)
        self._orders.put((station, None))

    def turn(self, wait_ms: int = _POLL_MS) -> None:
        """Wait for a station, and pass on its messages."""
        self._wait(wait_ms)
        self._obey()
        for arrival in self._door.arrivals():
            try:
                self._handle(arrival)
            except Exception:  # streams of other stations must go on
                log.exception("streams of a station's computer cannot be taken up")
                self._door.cut(arrival.route, "the lab cannot process what it sends: see the log of its gate")
        self._answer_senders()
        for route in self._door.gone:
            self._forget_sender(route)
            if (flow := self._by_route.pop(route, None)) is not None and flow.route == route:
                flow.route, flow.credit = b"", 0
        self._door.gone.clear()
        self._door.poll()
        for (station, _), flow in self._flows.items():
            if flow.published.rebind_if_unreachable():
                self._update_places(station)
            if flow.route and not self._allowed.now.may_be(self._door.key_of(flow.route), station):
                self._leave(flow, "the lab has withdrawn or replaced this station's key")
            self._send_credits(flow)
        for route, sender in list(self._senders.items()):
            has_state = (sender.station, STATE) in self._flows
            if not has_state or not self._allowed.now.may_be(self._door.key_of(route), sender.station):
                self._cut_sender(route, "the lab has withdrawn or replaced this station's key")

    def _wait(self, wait_ms: int) -> None:
        poller = zmq.Poller()
        poller.register(self._door.socket, zmq.POLLIN)
        if self._incoming is not None:
            poller.register(self._incoming.wake, zmq.POLLIN)
        poller.poll(wait_ms)

    def _leave(self, flow: _Flow, reason: str, again_s: float = 30.0) -> None:
        self._by_route.pop(flow.route, None)
        self._door.cut(flow.route, reason, again_s)
        flow.route, flow.credit = b"", 0

    def _work(self) -> None:
        try:
            while not self._ended.is_set():
                self.turn()
        except Exception:
            log.exception("streams of stations elsewhere end")
            self.failed = True
        finally:
            for flow in self._flows.values():
                flow.published.close()
            self._door.close()
            if self._incoming is not None:
                self._incoming.end()

    def _obey(self) -> None:
        with suppress(Empty):
            while True:
                station, station_dir = self._orders.get_nowait()
                self._close(station)
                if station_dir is not None:
                    self._open(station, station_dir)

    def _open(self, station: str, folder: Path) -> None:
        try:
            state = Publisher(self.context, folder, "state", STREAM_HIGH_WATER)
            pictures = Publisher(self.context, folder, "cameras", CAMERA_HIGH_WATER)
        except (TransportError, OSError, zmq.ZMQError) as error:
            log.error("streams of %s cannot be published: %s", station, error)
            return
        self._flows[station, STATE] = _Flow(state, STATE)
        self._flows[station, PICTURES] = _Flow(pictures, PICTURES)
        self._update_places(station)

    def _close(self, station: str) -> None:
        for role in (STATE, PICTURES):
            if (flow := self._flows.pop((station, role), None)) is not None:
                flow.published.close()
                if flow.route:
                    self._leave(flow, "the lab has no such station any more")

    def _update_places(self, station: str) -> None:
        state, pictures = (self._flows[station, role].published.endpoint for role in (STATE, PICTURES))
        self.places[station] = (state, pictures)

    def _handle(self, arrival: Arrival) -> None:
        message, flow = arrival.message, self._by_route.get(arrival.route)
        if (sender := self._senders.get(arrival.route)) is not None:
            self._on_sender(arrival, sender)
        elif isinstance(message, Hello) and flow is None:
            self._greet(arrival, message)
        elif flow is None:
            self._door.cut(arrival.route, "it did not say who it is")
        elif isinstance(message, Beat):
            self._door.send(arrival.route, Beat())
        elif isinstance(message, Bundle):
            self._pass_on(arrival, message, flow)

    def _greet(self, arrival: Arrival, hello: Hello) -> None:
        sends = hello.role == EPISODES and self._incoming is not None
        flow = self._flows.get((hello.station, STATE if sends else hello.role))
        if not self._allowed.now.may_be(arrival.key, hello.station) or flow is None:
            self._door.cut(arrival.route, f"{hello.station!r:.80} is not known here with this key", _SOON_S)
            return
        if reason := apart(hello.release, hello.version, hello.station, lab_side=True):
            self._door.cut(arrival.route, reason)
            return
        replaced = "another connection of this station has taken its place"
        if sends:
            for route in [
                route for route, sender in self._senders.items() if sender.station == hello.station
            ]:
                self._cut_sender(route, replaced, _SOON_S)
            self._senders[arrival.route] = _Sender(hello.station)
            self._door.send(arrival.route, Welcome(RELEASE, version()))
            return
        if flow.route:
            self._leave(flow, replaced, _SOON_S)
        flow.route, flow.credit, flow.asked = arrival.route, 0, []
        self._by_route[arrival.route] = flow
        self._door.send(arrival.route, Welcome(RELEASE, version()))

    def _pass_on(self, arrival: Arrival, bundle: Bundle, flow: _Flow) -> None:
        flow.credit -= 1
        if flow.credit < -_SLACK or len(bundle.streams) != len(arrival.parts):
            self._door.cut(arrival.route, "it sends data that was not requested")
            return
        if flow.credit < 0:
            return
        for stream, payload in zip(bundle.streams, arrival.parts, strict=True):
            if _NAMES[flow.role].fullmatch(stream):
                flow.published.publish(stream, payload)

    def _send_credits(self, flow: _Flow) -> None:
        """Renew the credit while there are subscribers; send the list of wanted streams if it has changed."""
        flow.published.poll_subscriptions()
        topics = sorted(flow.published.topics)[:_MOST_TOPICS]
        if not flow.route:
            return
        count = _WINDOW[flow.role] - max(0, flow.credit) if topics else 0
        if not count and topics == flow.asked:
            return
        if self._door.send(flow.route, Credit(count, topics)):
            flow.credit, flow.asked = max(0, flow.credit) + count, topics

    # --- episodes ------------------------------------------------------------------------------------------------

    def _on_sender(self, arrival: Arrival, sender: _Sender) -> None:
        message, incoming = arrival.message, self._incoming
        assert incoming is not None
        if isinstance(message, Beat):
            self._door.send(arrival.route, Beat())
        elif isinstance(message, Offer | Labels | Piece) and len(arrival.parts) == 1:
            if sender.may_send(message):
                incoming.handle(sender.station, arrival.route, message, arrival.parts[0])
            else:
                self._cut_sender(arrival.route, "it sends data that was not requested")

    def _answer_senders(self) -> None:
        """Send the answers about episodes, and update how many pieces and offers each station may still send."""
        for route, message in self._incoming.answers() if self._incoming is not None else ():
            sender = self._senders.get(route)
            if sender is None:
                continue
            if isinstance(message, Want):
                sender.asked += 1
            else:
                sender.offered -= 1
            if not self._door.send(route, message):
                self._cut_sender(route, "it does not read what it requested", _SOON_S)

    def _cut_sender(self, route: bytes, reason: str, again_s: float = 30.0) -> None:
        self._forget_sender(route)
        self._door.cut(route, reason, again_s)

    def _forget_sender(self, route: bytes) -> None:
        sender = self._senders.pop(route, None)
        if sender is not None and self._incoming is not None:
            self._incoming.left(sender.station, route)
