"""Station's end of the link: threads that carry commands, stops and streams between the lab and this computer.

Stops have their own connection to the lab, thread and connections to the station, so that they never wait behind
anything else.
"""

from __future__ import annotations

import logging
import secrets
import threading
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import zmq
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from runtime.core.errors import ConfigurationError
from runtime.ipc.bus import Key
from runtime.link.key_files import KeyPair, KnownLab
from runtime.link.line import Dial, Line
from runtime.link.relay import ALLOWED, Relay
from runtime.link.station_streams import Flow, source_of
from runtime.link.tokens import Challenges
from runtime.link.uploads import Uploads, UploadSettings
from runtime.link.wire import COMMANDS, EPISODES, PICTURES, STATE, STOPS, Answer, Ask, Beat, Credit
from runtime.link.yielding import lower_priority

log = logging.getLogger(__name__)
_POLL_MS = 50
_IDLE_MS = 100  # longest wait of a turn without pending requests
_LOOK_S = 0.2  # between two checks of which processes listen [s]
# Replaces the signature of a message without a verified user: the station obeys such a message only if it is a stop.
NOBODY = b"nobody known to the lab"
_UPLOAD_AGAIN_S = 30.0  # pause after an unforeseen error [s]
_MOST_STREAMS_S = 1 / 40  # shortest time between two bundles [s]


@dataclass(frozen=True, slots=True)
class Place:
    """Station of this computer, its lab, and the key that identifies it to the lab."""

    station_dir: Path
    lab: KnownLab
    key: KeyPair
    session: bytes

    def dial(self, role: str) -> Dial:
        """Return the parameters of a connection of that role."""
        return Dial(self.lab, self.key, role, self.session)


class Commands:
    """Relay of the lab's commands over the connection of one role. One thread uses it and calls `turn`."""

    def __init__(self, place: Place, role: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._place, self._role, self._clock = place, role, clock
        self._context: zmq.Context[Any] = (
            zmq.Context()
        )  # own context: traffic of other roles causes no delay here
        self._relay = Relay(self._context, place.station_dir, clock)
        tokens = Ed25519PublicKey.from_public_bytes(bytes.fromhex(place.lab.tokens))
        self._challenges = Challenges(place.lab.station, tokens, clock)
        self._bus_key = Key(place.station_dir)
        self._listening: list[str] = []
        self._looked = -float("inf")
        self._line = Line(self._context, place.dial(role), self._beat, clock)
        self._connection = 0

    def turn(self) -> None:
        """Wait for messages from the lab or the station, and pass them on."""
        wait_ms = _POLL_MS if self._relay.is_pending else _IDLE_MS
        poller = zmq.Poller()
        for socket in (self._line.socket, *self._relay.sockets()):
            if socket is not None:
                poller.register(socket, zmq.POLLIN)
        poller.poll(wait_ms)
        for message, parts in self._line.turn():
            if isinstance(message, Ask) and len(parts) == 1:
                self._ask(message, parts[0])
        if self._line.connections != self._connection:
            self._connection = self._line.connections
            self._relay.forget()
        for answer in self._relay.answers():
            self._line.send(Answer(answer.number, answer.failure), answer.packed)

    @property
    def problem(self) -> str:
        """Reason why there is no connection to the lab, "" if there is one; any thread may read it."""
        return "" if self._line.up else self._line.why

    def close(self) -> None:
        """Release all sockets."""
        self._line.close()
        self._relay.close()
        self._context.destroy(linger=0)

    def _beat(self) -> Beat:
        now = self._clock()
        if (
            self._role == COMMANDS and now - self._looked >= _LOOK_S
        ):  # on one connection only: two reports could contradict each other
            self._looked, self._listening = now, self._relay.listening()
        return Beat(self._challenges.newest(), self._listening)

    def _ask(self, ask: Ask, payload: bytes) -> None:
        if (ask.process, ask.socket) not in ALLOWED:
            refusal = f"{ask.process}/{ask.socket} is no socket that a lab may use"
            self._line.send(Answer(ask.number, refusal), b"")
            return
        wrong = self._challenges.wrong(ask, payload)
        if wrong and not ask.stops:
            log.warning("a command of the lab is not passed on: %s", wrong)
            self._line.send(Answer(ask.number, f"the station did not take it: {wrong}"), b"")
            return
        if wrong:
            log.warning("a stop of the lab is passed on, of a user who is not verified: %s", wrong)
        signature = NOBODY if wrong else self._signature(payload)
        self._relay.send(ask.number, (ask.process, ask.socket), payload, signature, ask.stops)

    def _signature(self, payload: bytes) -> bytes:
        try:
            return self._bus_key.sign(payload)
        except ConfigurationError as error:
            log.error("a command of the lab is passed on without a signature: %s", error)
            return NOBODY


class Streams:
    """Relay of state and pictures: the newest message of each stream, within the lab's credit.

    One thread calls `turn`.
    """

    def __init__(self, place: Place, clock: Callable[[], float] = time.monotonic) -> None:
        self._context: zmq.Context[Any] = zmq.Context()
        self._clock = clock
        self._flows = [self._flow(place, role) for role in (STATE, PICTURES)]
        self._connections = [0] * len(self._flows)
        self._sent_at = [-float("inf")] * len(self._flows)

    def _flow(self, place: Place, role: str) -> tuple[Line, Flow]:
        line = Line(self._context, place.dial(role), Beat, self._clock)
        return line, Flow(self._context, source_of(place.station_dir, role))

    def turn(self, wait_ms: int = _IDLE_MS) -> None:
        """Wait for messages from the lab or the station, and pass them on.

        New messages of the station are sent only as far as the lab has granted credit for them. The wait lasts at most
        `wait_ms` [ms].
        """
        now = self._clock()
        poller = zmq.Poller()
        for (line, flow), sent_at in zip(self._flows, self._sent_at, strict=True):
            if line.socket is not None:
                poller.register(line.socket, zmq.POLLIN)
            if flow.socket is not None and now - sent_at >= _MOST_STREAMS_S:
                poller.register(flow.socket, zmq.POLLIN)
            elif flow.socket is not None:
                wait_ms = min(wait_ms, int(1000 * (sent_at + _MOST_STREAMS_S - now)) + 1)
        poller.poll(wait_ms)
        for at, (line, flow) in enumerate(self._flows):
            self._pass(at, line, flow)

    def _pass(self, at: int, line: Line, flow: Flow) -> None:
        received = line.turn()
        if (
            line.connections != self._connections[at] or not line.up
        ):  # credit belongs to the connection that granted it
            flow.stop()
            self._connections[at] = line.connections
        for message, _ in received:
            if isinstance(message, Credit):
                flow.allow(message)
        now = self._clock()
        if now - self._sent_at[at] < _MOST_STREAMS_S:
            return
        if (bundle := flow.bundle()) is not None and line.send(bundle[0], *bundle[1]):
            self._sent_at[at] = now

    def close(self) -> None:
        """Release all sockets."""
        for line, flow in self._flows:
            line.close()
            flow.close()
        self._context.destroy(linger=0)


class StationLink:
    """Threads of one station's link; without `uploads` no episode is sent."""

    def __init__(
        self, station_dir: Path, lab: KnownLab, key: KeyPair, uploads: UploadSettings | None = None
    ) -> None:
        self._place = Place(station_dir, lab, key, secrets.token_bytes(16))
        self._ended = threading.Event()
        self.failed = threading.Event()
        self._stops: Commands | None = None
        self._threads = [
            threading.Thread(target=self._work, args=(name, make), name=name, daemon=True)
            for name, make in (
                (STOPS, partial(Commands, self._place, STOPS)),
                (COMMANDS, partial(Commands, self._place, COMMANDS)),
                ("streams", partial(Streams, self._place)),
            )
        ]
        if uploads is not None:
            make = partial(Uploads, self._place.dial(EPISODES), station_dir, uploads)
            self._threads.append(
                threading.Thread(target=self._upload, args=(make,), name=EPISODES, daemon=True)
            )

    def start(self) -> None:
        """Start the threads and return."""
        for thread in self._threads:
            thread.start()

    def end(self) -> None:
        """Stop all threads and wait for them."""
        self._ended.set()
        for thread in self._threads:
            thread.join()

    @property
    def problem(self) -> str:
        """Reason why the lab cannot stop the station at present, "" if it can."""
        return "not connected yet" if self._stops is None else self._stops.problem

    def _work(self, name: str, make: Callable[[], Commands | Streams]) -> None:
        """Run one thread of the link.

        An unforeseen error sets `failed`, so that the whole process ends and is restarted: a link of which only some
        threads work would be harder to notice.
        """
        part = None
        try:
            part = make()
            if name == STOPS and isinstance(part, Commands):
                self._stops = part
            while not self._ended.is_set():
                part.turn()
        except Exception:
            log.exception("the link's thread %s ends", name)
            self.failed.set()
        finally:
            if part is not None:
                part.close()

    def _upload(self, make: Callable[[], Uploads]) -> None:
        """Run the thread of episodes. It restarts after errors and never affects stops and commands."""
        lower_priority()
        while not self._ended.is_set():
            try:
                with closing(make()) as part:
                    while not self._ended.is_set():
                        part.turn()
            except Exception:
                log.exception("episodes are sent to the lab again in %g s", _UPLOAD_AGAIN_S)
                self._ended.wait(_UPLOAD_AGAIN_S)
