"""Connection of a station to its lab: connecting, greeting, signs of life, and dropping a silent connection.

The station connects, never the lab. Messages that are still unread when a connection is dropped are discarded: they
belong to requests that the lab no longer waits for.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import zmq
from zmq.utils.monitor import recv_monitor_message

from runtime.core.errors import CodecError
from runtime.ipc.readable import readable
from runtime.link.key_files import KeyPair, KnownLab, z85
from runtime.link.release import version
from runtime.link.wire import (
    BEAT_S,
    COMMANDS,
    EPISODES,
    LARGEST_ANSWER,
    LOST_EPISODES_S,
    LOST_S,
    RELEASE,
    ROLES,
    STOPS,
    Beat,
    Bye,
    Hello,
    Message,
    Welcome,
    apart,
    read,
    write,
)

log = logging.getLogger(__name__)
_GREETED_S = 2.0  # [s], for connecting and the lab's welcome
_SHORTEST_S, _LONGEST_S = 0.1, 2.0  # [s], between two tries
_REFUSED_S = 30.0  # [s], after the lab has refused the key
_MOST_WAIT_S = 300.0
_TURN = 100  # messages read per turn
_WAITING_TO_GO = 64  # queued messages at which a connection counts as lost
_FATAL = zmq.EVENT_HANDSHAKE_FAILED_AUTH | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
_FATAL |= zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL | zmq.EVENT_DISCONNECTED | zmq.EVENT_CLOSED
_AUTH = zmq.EVENT_HANDSHAKE_FAILED_AUTH
_LOW_EFFORT = 0x20  # TOS of DSCP CS1: routers that know it prefer all other traffic
Heard = tuple[Message, list[bytes]]


@dataclass(frozen=True, slots=True)
class Dial:
    """Parameters of a connection to the lab: lab, key of this computer, role and session."""

    lab: KnownLab
    key: KeyPair
    role: str
    session: bytes

    @property
    def endpoint(self) -> str:
        port = self.lab.port if self.role in (STOPS, COMMANDS) else self.lab.second_port
        host = f"[{self.lab.host}]" if ":" in self.lab.host else self.lab.host
        return f"tcp://{host}:{port}"


Dialled = tuple[zmq.Socket[Any], zmq.Socket[Any]]  # connection and its monitor


def dialled(context: zmq.Context[Any], endpoint: str, lab: bytes, key: KeyPair, low: bool = False) -> Dialled:
    """Open a socket that connects once, without reconnecting, to the lab with the public key `lab`. Raises: ZMQError.

    Args:
        lab: Public key of the lab, 32 bytes.
        low: Mark the packets as low priority (DSCP CS1).

    Returns:
        The socket and its monitor.
    """
    socket: zmq.Socket[Any] = context.socket(zmq.DEALER)
    socket.linger = 0
    if low:
        socket.set(zmq.TOS, _LOW_EFFORT)
    socket.set(zmq.IPV6, 1)
    socket.set(zmq.RECONNECT_IVL, -1)
    socket.set(zmq.HANDSHAKE_IVL, int(_GREETED_S * 1000))
    socket.set(zmq.MAXMSGSIZE, LARGEST_ANSWER)
    socket.set(zmq.SNDHWM, _WAITING_TO_GO)
    socket.curve_serverkey, socket.curve_publickey, socket.curve_secretkey = (
        z85(lab),
        z85(key.public),
        z85(key.secret),
    )
    monitor = socket.get_monitor_socket(_FATAL)  # before connecting, so that no event is missed
    try:
        socket.connect(endpoint)
    except zmq.ZMQError:
        ended(socket, monitor)
        raise
    return socket, monitor


def ended(socket: zmq.Socket[Any], monitor: zmq.Socket[Any]) -> None:
    """Close a socket and its monitor; queued messages are discarded."""
    socket.disable_monitor()
    monitor.close(linger=0)
    socket.close(linger=0)


class Line:
    """Connection of a station to its lab in one role. One thread uses it and calls `turn` regularly.

    `beat` returns the sign of life that the station sends every BEAT_S.
    """

    def __init__(
        self,
        context: zmq.Context[Any],
        dial: Dial,
        beat: Callable[[], Beat] = Beat,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        assert dial.role in ROLES
        self._context, self._dial, self._beat, self._clock = context, dial, beat, clock
        self.socket: zmq.Socket[Any] | None = None
        self._monitor: zmq.Socket[Any] | None = None
        self.up = False
        self.why = "not connected yet"
        self._heard_at = self._due = -float("inf")
        self._pause = _SHORTEST_S
        self._low = dial.role == EPISODES
        self._again_at = -float("inf")
        self.connections = 0  # number of welcomes: a request belongs to the connection that carried it

    def turn(self) -> list[Heard]:
        """Connect if it is due, send a sign of life, and return the messages received since the last call."""
        now = self._clock()
        if self.socket is None:
            if now >= self._again_at:
                self._open(now)
            return []
        # Before reading: a command that arrives after a silence may be old, so it is dropped with the connection.
        lost = LOST_EPISODES_S if self._low else LOST_S
        if now - self._heard_at > (lost if self.up else _GREETED_S):
            self.drop(f"no message from the lab for {now - self._heard_at:.1f} s")
            return []
        received = self._received(now)
        if self.socket is not None and (trouble := self._connection_problem()):
            self.drop(*trouble)
        elif self.up and now >= self._due:
            self._due = now + BEAT_S
            self.send(self._beat())
        return received

    def send(self, message: Message, *parts: bytes) -> bool:
        """Send a message without waiting; return False if there is no connection or its queue is full."""
        if self.socket is None:
            return False
        try:
            self.socket.send_multipart(write(message, *parts), zmq.NOBLOCK)
        except zmq.Again:
            self.drop(f"the lab has not taken {_WAITING_TO_GO} messages")
            return False
        return True

    def drop(self, why: str, again_s: float | None = None) -> None:
        """Close the connection and discard its pending messages.

        Args:
            why: Reason, logged if it is new.
            again_s: Time until the next attempt [s]; None: soon, then with a growing delay of up to `_LONGEST_S`.
        """
        self.close()
        if why != self.why:
            log.warning("no %s connection to the lab at %s: %s", self._dial.role, self._dial.endpoint, why)
        self.up, self.why = False, why
        if again_s is None:
            again_s, self._pause = self._pause, min(2 * self._pause, _LONGEST_S)
        self._again_at = self._clock() + min(max(again_s, _SHORTEST_S), _MOST_WAIT_S)

    def close(self) -> None:
        """Release the socket; nothing more is sent."""
        if self.socket is not None and self._monitor is not None:
            ended(self.socket, self._monitor)
        self.socket = self._monitor = None

    def _open(self, now: float) -> None:
        lab = self._dial.lab
        self._heard_at = now
        try:
            lab_key = bytes.fromhex(lab.key)
            connection = dialled(self._context, self._dial.endpoint, lab_key, self._dial.key, self._low)
        except zmq.ZMQError as error:
            self.drop(f"{self._dial.endpoint} is no address: {error.strerror}", _REFUSED_S)
            return
        self.socket, self._monitor = connection
        self.send(Hello(RELEASE, version(), lab.station, self._dial.role, self._dial.session))

    def _received(self, now: float) -> list[Heard]:
        received: list[Heard] = []
        for _ in range(_TURN):
            if self.socket is None:
                return []
            if not readable(self.socket):
                break
            try:
                message, parts = read(self.socket.recv_multipart(zmq.NOBLOCK))
            except zmq.Again:
                break
            except CodecError as error:
                self.drop(f"unreadable message from the lab: {error}", _REFUSED_S)
                return []
            self._heard_at = now
            if isinstance(message, Welcome):
                self._welcomed(message)
            elif isinstance(message, Bye):
                self.drop(message.why, message.again_s)
                return []
            elif self.up and not isinstance(message, Beat):
                received.append((message, parts))
        return received

    def _welcomed(self, lab: Welcome) -> None:
        if reason := apart(lab.release, lab.version, self._dial.lab.station, lab_side=False):
            self.drop(reason, _REFUSED_S)
            return
        if self.why:
            log.info("the %s connection to the lab at %s is there", self._dial.role, self._dial.endpoint)
        self.up, self.why, self._pause = True, "", _SHORTEST_S
        self._due = -float("inf")
        self.connections += 1

    def _connection_problem(self) -> tuple[str, float | None] | None:
        """Return the reason why ZMQ reports the connection as failed, and the delay of the next attempt [s].

        None if it does not report a failure.
        """
        assert self._monitor is not None
        if not readable(self._monitor):
            return None
        with suppress(zmq.Again):
            event = recv_monitor_message(self._monitor, zmq.NOBLOCK)
            if event["event"] == _AUTH:
                return (
                    "the lab knows no such key: it was withdrawn or replaced, or never enrolled",
                    _REFUSED_S,
                )
            if event["event"] in (zmq.EVENT_DISCONNECTED, zmq.EVENT_CLOSED):
                return "the lab does not answer at this address, or has closed the connection", None
            return "the server at this address is not this lab, or speaks another protocol", None
        return None
