"""The ZMQ link to an execution node: the node binds, we connect; PUB/SUB, single frames, openpi arrays.

The wire has no handshake, no authentication and no encryption, so beyond loopback it must be asked for.
"""

from __future__ import annotations

import contextlib
import ipaddress
import logging
import threading
import uuid
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import zmq
from pydantic import Field, model_validator

from runtime import codecs
from runtime.clock import Clock, ClockMap
from runtime.errors import ConfigurationError, TransportError
from runtime.section import Section
from runtime.transports.base import Capabilities, Sink, Source
from runtime.transports.freshness import FROZEN_S, Freshness
from runtime.transports.node_messages import Encoding, MessageRefused, NodeFrame, NodeMessages, NodeStatus
from runtime.types import Observation, RobotCommand, UInt8

if TYPE_CHECKING:
    from robots import Robot

log = logging.getLogger(__name__)
Endpoint = Annotated[str, Field(pattern=r"^(tcp|ipc|inproc)://.+")]
MESSAGE_LIMIT = 64 * 1024 * 1024  # bytes; three 1080p pictures are 19 MB
_QUEUED_FRAMES = 4
_QUEUED_COMMANDS = 2
_WAKE_MS = 50  # how soon the reader notices that it is to end
_REOPEN_S = 1.0


class Config(Section):
    """An execution node over ZMQ."""

    kind: Literal["zmq"] = "zmq"
    sub_endpoint: Endpoint = "tcp://127.0.0.1:5555"
    """Where the node publishes observations."""
    pub_endpoint: Endpoint = "tcp://127.0.0.1:5556"
    """Where the node takes commands."""
    encoding: Encoding = "bgr"
    """Colour order of the node's pictures; an `encoding` field on the wire wins."""
    disabled_cameras: list[str] = Field(default_factory=list)
    """Observation keys of cameras that this deployment does without."""
    detect_frozen: bool = True
    """A picture exactly like the one before counts as no newer; off for simulated cameras that may stand still."""
    simulated: bool = False
    """The node is a simulated bench: it may be reset by us, and what it says is the truth of it is believed."""
    insecure_link: bool = False
    """Allow endpoints beyond this machine although anybody on that network can command the robot."""

    @model_validator(mode="after")
    def _stay_on_this_machine(self) -> Config:
        for key in ("sub_endpoint", "pub_endpoint"):
            endpoint = getattr(self, key)
            if endpoint.startswith("tcp://") and not _has_port(endpoint):
                raise ConfigurationError(
                    f"transport.{key} = {endpoint!r}; allowed: tcp://HOST:PORT with a port from 1 to 65535"
                )
            if not self.insecure_link and not is_loopback(endpoint):
                raise ConfigurationError(
                    f"transport.{key} = {endpoint!r} leaves this machine over a plain link; "
                    "allowed: a loopback address, or insecure_link = true on a network you trust"
                )
        return self


def is_loopback(endpoint: str) -> bool:
    """Whether an endpoint cannot be reached from another machine."""
    scheme, _, rest = endpoint.partition("://")
    if scheme in {"ipc", "inproc"}:
        return True
    host = rest.rpartition(":")[0].strip("[]")
    if host == "localhost":
        return True
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return False


def _has_port(endpoint: str) -> bool:
    """Whether it ends in a port one can connect to; libzmq takes any number and then waits for ever."""
    port = endpoint.rpartition(":")[2]
    return port.isascii() and port.isdigit() and 0 < int(port) < 65536


def capabilities(config: Config) -> Capabilities:
    """A real robot may hang on it; poses are delivered where the node sends them."""
    return Capabilities(moves_robot=True, measures_eef=True, resets_bench=config.simulated)


def cameras(config: Config, robot: Robot) -> tuple[str, ...]:
    """Keys of the robot's cameras that this deployment has."""
    return tuple(camera.key for camera in robot.cameras if camera.key not in config.disabled_cameras)


def source(config: Config, robot: Robot, clock: Clock) -> NodeSource:
    """The observations of the node; ConfigurationError for a disabled camera that the robot does not have."""
    return NodeSource(config, robot, clock)


def sink(config: Config, robot: Robot, clock: Clock) -> NodeSink:
    """The commands to the node."""
    return NodeSink(config, robot, clock)


class NodeSource(Source):
    """One SUB socket, emptied all the time by a thread of its own, so that no frame grows old in a queue.

    Newest is newest by arrival: a node that restarts has a smaller clock, and its frames count at once.
    `Observation.sequence` counts the usable frames since connect, whatever the node's own numbers do. What
    goes wrong in the thread is counted, and where the socket itself fails another one is opened.
    """

    def __init__(self, config: Config, robot: Robot, clock: Clock) -> None:
        known = [camera.key for camera in robot.cameras]
        unknown = [key for key in config.disabled_cameras if key not in known]
        if unknown:
            raise ConfigurationError(
                f"transport.disabled_cameras = {unknown} are no cameras of {robot.name}; "
                f"allowed: {', '.join(known)}"
            )
        self._endpoint = config.sub_endpoint
        self._detect_frozen = config.detect_frozen
        self._simulated = config.simulated
        self._clock = clock
        self._messages = NodeMessages(
            robot, config.encoding, frozenset(config.disabled_cameras), MESSAGE_LIMIT
        )
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        self._ending = threading.Event()
        self._newest: tuple[int, float, Mapping[str, float], NodeFrame] | None = None
        self._forget()

    def connect(self) -> None:
        """Start to listen; a node that is not there yet is found by itself when it comes."""
        self.close()
        self._forget()
        self._ending.clear()
        try:
            socket = self._subscribed()
        except zmq.ZMQError as error:
            raise TransportError(f"cannot listen to the node at {self._endpoint}: {error}") from error
        self._thread = threading.Thread(target=self._read, args=(socket,), name="node-source", daemon=True)
        self._thread.start()

    def receive(self, timeout: float) -> Observation | None:
        """The newest complete frame not yet delivered, as RGB; None after `timeout` seconds without one."""
        with self._changed:
            self._changed.wait_for(lambda: self._newest is not None, timeout)
            newest, self._newest = self._newest, None
        return None if newest is None else _observation(*newest)

    def close(self) -> None:
        """Stop listening."""
        self._ending.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def faults(self) -> dict[str, int]:
        """Refused messages by reason, `clock_backwards`, `frames_lost` (gaps in the node's own numbers).

        `frozen_<camera>` counts how often that camera's picture stayed the same for too long.
        `truth_ignored` is 1 where a node that is not declared simulated says what only a simulated one can know.
        `drives_unusable` counts messages whose drive state could not be read.
        Commands that the node itself refused appear as `node_refused.<reason>`.
        """
        with self._changed:
            counts = dict(self._faults)
            if self._map.restarts:
                counts["clock_backwards"] = self._map.restarts
            return counts | {f"node_refused.{reason}": n for reason, n in self._status.refused.items()}

    @property
    def last_fault(self) -> str:
        """The sentence of the newest fault; empty where there was none."""
        return self._last_fault

    @property
    def status(self) -> NodeStatus:
        """What the node said of itself in its newest usable message."""
        return self._status

    def _forget(self) -> None:
        self._map = ClockMap()
        self._freshness = Freshness()
        self._faults: Counter[str] = Counter()
        self._last_fault = ""
        self._status = NodeStatus()
        self._count = 0
        self._peer_sequence: int | None = None
        self._newest = None

    def _subscribed(self) -> zmq.Socket[bytes]:
        """A socket that hears the node; raises ZMQError."""
        socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.SUB)
        try:
            socket.setsockopt(zmq.RCVHWM, _QUEUED_FRAMES)
            socket.setsockopt(zmq.LINGER, 0)
            socket.setsockopt(zmq.MAXMSGSIZE, MESSAGE_LIMIT)
            socket.setsockopt(zmq.SUBSCRIBE, b"")
            socket.connect(self._endpoint)
        except zmq.ZMQError:
            socket.close()
            raise
        return socket

    def _read(self, socket: zmq.Socket[bytes] | None) -> None:
        """The thread: nothing that happens in it may end it, because nobody else listens to the node."""
        while not self._ending.is_set():
            try:
                if socket is None:
                    socket = self._subscribed()
                if socket.poll(_WAKE_MS):
                    self._take(_drain(socket), self._clock.now())
            except zmq.ZMQError as error:
                self._blame("socket_failed", f"the socket failed and is opened anew: {error}")
                if socket is not None:
                    socket.close()
                    socket = None
                self._ending.wait(_REOPEN_S)
            except Exception as error:
                self._blame_ourselves(error)
                self._ending.wait(_WAKE_MS / 1000)  # so that an error that stays does not spin
        if socket is not None:
            socket.close()

    def _take(self, payloads: list[bytes], arrived: float) -> None:
        """Keep the newest usable message; a partial or broken one never displaces an older complete one."""
        for payload in reversed(payloads):
            try:
                frame = self._messages.read(payload)
            except MessageRefused as error:
                self._blame(error.fault, str(error))
            else:
                self._keep(frame, arrived)
                return

    def _keep(self, frame: NodeFrame, arrived: float) -> None:
        for fault, text in frame.remarks:
            self._blame(fault, text)
        if frame.truth is not None and not self._simulated:
            self._ignore_truth()
            frame = replace(frame, truth=None)
        captured = self._captured(frame, arrived)
        with self._changed:
            self._count_lost(frame.sequence)
            self._count += 1
            self._status = frame.status
            self._newest = (self._count, arrived, captured, frame)
            self._changed.notify_all()

    def _ignore_truth(self) -> None:
        """Said once: every message of such a node has it."""
        if "truth_ignored" not in self._faults:
            text = "it says the truth of a bench, but transport.simulated is false"
            self._blame("truth_ignored", text)

    def _captured(self, frame: NodeFrame, arrived: float) -> dict[str, float]:
        """The time of each stream: the message's, but for pictures that are no new ones."""
        time = self._map.map(frame.stamp, arrived)
        times = dict.fromkeys(["joints", *(["eef"] if frame.eef is not None else []), *frame.pictures], time)
        if self._detect_frozen:
            times |= self._freshness.captured(frame.pictures, time)
            for camera in self._freshness.newly_frozen(time):
                self._blame(f"frozen_{camera}", f"{camera} shows the same picture for over {FROZEN_S:g} s")
        return times

    def _count_lost(self, sequence: int | None) -> None:
        if sequence is not None and self._peer_sequence is not None and sequence > self._peer_sequence + 1:
            self._faults["frames_lost"] += sequence - self._peer_sequence - 1
        self._peer_sequence = sequence

    def _blame(self, fault: str, text: str) -> None:
        with self._changed:
            self._faults[fault] += 1
            self._last_fault = f"{self._endpoint}: {text}"

    def _blame_ourselves(self, error: Exception) -> None:
        text = f"reading failed: {type(error).__name__}: {error}"
        if not self._last_fault.endswith(text):  # once, not thirty times a second
            log.error("%s: %s", self._endpoint, text, exc_info=error)
        self._blame("reader_failed", text)


class NodeSink(Sink):
    """One PUB socket; what cannot leave at once is dropped, and nothing waits for a node that is away.

    Each says who sends it (`master`, one id per sink) and its number (`seq`); older nodes ignore both.
    """

    def __init__(self, config: Config, robot: Robot, clock: Clock) -> None:
        self._endpoint = config.pub_endpoint
        self._dim = robot.dim
        self._clock = clock
        self._socket: zmq.Socket[bytes] | None = None
        self._sequence = 0
        self.master = uuid.uuid4().hex

    def connect(self) -> None:
        """Open the socket; a node that is not there yet is found by itself when it comes."""
        self.close()
        socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.PUB)
        try:
            socket.setsockopt(zmq.SNDHWM, _QUEUED_COMMANDS)
            # Without this a node that comes back is given the commands of the moment it went away.
            socket.setsockopt(zmq.IMMEDIATE, 1)
            socket.setsockopt(zmq.LINGER, 0)
            socket.connect(self._endpoint)
        except zmq.ZMQError as error:
            socket.close()
            raise TransportError(f"cannot reach the node at {self._endpoint}: {error}") from error
        self._socket = socket

    def send(self, command: RobotCommand) -> None:
        """Hand over one absolute target; TransportError for a vector that no node may be given."""
        action = np.asarray(command.action, dtype=np.float32)
        if action.shape != (self._dim,) or not np.isfinite(action).all():
            raise TransportError(
                f"a command of shape {list(action.shape)} {action.tolist()} was to be sent; "
                f"allowed: {self._dim} finite numbers"
            )
        self._send({"t": float(command.time), "action": action, "target": "real"})

    def tell(self, word: str, data: Mapping[str, Any]) -> None:
        """Hand over the control word `word`: it stands where a command says its target, its fields beside it."""
        taken = sorted({"t", "target", "action", "master", "seq"} & set(data))
        if taken or word in ("real", "sim"):
            raise TransportError(f"the control word {word!r} with {taken} would be taken for a command")
        self._send({**data, "t": self._clock.now(), "target": word})

    def _send(self, message: dict[str, Any]) -> None:
        if self._socket is None:
            raise TransportError(f"the link to {self._endpoint} is not connected; connect it before sending")
        self._sequence += 1
        message |= {"master": self.master, "seq": self._sequence}
        with contextlib.suppress(zmq.Again):  # the newest command counts; the next one comes in a tick
            self._socket.send(codecs.pack(message), zmq.NOBLOCK)

    def close(self) -> None:
        """Close the socket; what has not left yet is forgotten."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


def _drain(socket: zmq.Socket[bytes]) -> list[bytes]:
    """Everything that has arrived by now, oldest first; bounded, so that a flood cannot keep us here."""
    payloads: list[bytes] = []
    with contextlib.suppress(zmq.Again):
        while len(payloads) < 4 * _QUEUED_FRAMES:
            payloads.append(socket.recv(zmq.NOBLOCK))
    return payloads


def _observation(
    sequence: int, arrived: float, captured: Mapping[str, float], frame: NodeFrame
) -> Observation:
    pictures = frame.pictures
    if frame.encoding == "bgr":
        pictures = {key: _swapped(picture) for key, picture in pictures.items()}
    return Observation(
        sequence=sequence,
        arrived=arrived,
        captured=MappingProxyType(captured),
        qpos=frame.qpos,
        pictures=MappingProxyType(pictures),
        eef=frame.eef,
        reported_action=frame.action,
        reported_action_eef=frame.action_eef,
        truth=frame.truth,
        drives=frame.drives,
    )


def _swapped(bgr: UInt8) -> UInt8:
    """RGB from BGR, ten times as fast as numpy would; imported here, as control locks all that it imports."""
    import cv2

    rgb = np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)
    rgb.flags.writeable = False
    return rgb
