"""Observations of an execution node over ZMQ: the newest by arrival, with times on our clock, and with counted
faults.
"""

from __future__ import annotations

import contextlib
import logging
import math
import threading
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
import zmq

from runtime.core.clock import Clock, ClockMap
from runtime.core.errors import TransportError
from runtime.core.sentences import Pattern, fixed
from runtime.core.types import Observation, UInt8
from runtime.ipc.messages import Event
from runtime.ipc.readable import readable
from runtime.transports import node_link
from runtime.transports.base import Source
from runtime.transports.frozen_cameras import FROZEN_S, FrozenCameraDetector
from runtime.transports.node_messages import (
    MESSAGE_LIMIT,
    MessageRefused,
    NodeFrame,
    NodeMessages,
    NodeStatus,
)

if TYPE_CHECKING:
    from robots import Robot
    from runtime.transports.node_link import NodeSettings

log = logging.getLogger(__name__)
_REFUSED_LATE = fixed(
    "node.refused_late",
    "commands came too late for the node: this machine, or the way to it, is too slow",
)
_REFUSED_LIMITS = fixed(
    "node.refused_limits",
    "commands were beyond the node's own limits",
)
_REFUSED_DIMENSION = fixed(
    "node.refused_dimension",
    "commands had another number of joints than the node",
)
_REFUSED_NOT_FINITE = fixed("node.refused_not_finite", "commands had numbers that are none")
_REFUSED_MALFORMED = fixed(
    "node.refused_malformed",
    "commands could not be read by the node",
)
_REFUSED_COLLECTING = fixed(
    "node.refused_collecting",
    "a person drives the robot: the node takes no commands",
)
_CANNOT_LISTEN = Pattern("node.cannot_listen", "cannot listen to the node at {endpoint}: {error}")
_SEVERAL_CLIENTS = Pattern(
    "node.several_clients",
    "several clients command the node, which obeys {client} alone",
)
_NOTHING_USABLE = Pattern(
    "node.nothing_usable",
    "waiting for the node at {endpoint}: nothing usable for {seconds:.1f} s: {why}",
)
_STOPPED = Pattern(
    "node.stopped",
    "waiting for the node at {endpoint}: nothing for {seconds:.1f} s: it has stopped, or the way to it is cut",
)
_NEVER_CAME = Pattern(
    "node.never_came",
    "waiting for the node at {endpoint}: no message for {seconds:.1f} s: check that it runs, and that it "
    "publishes where transport.sub_endpoint says",
)
_TRUTH_UNDECLARED = fixed(
    "node.truth_undeclared",
    "it says the truth of a bench, but transport.simulated is false",
)
_FROZEN_PICTURE = Pattern(
    "node.frozen_picture",
    "{camera} shows the same picture for over {seconds:g} s",
)
_CLOCK_BACK = fixed(
    "node.clock_back",
    "the node's clock went back: it was started anew, or its clock was set",
)
_CLOCK_AHEAD = fixed(
    "node.clock_ahead",
    "the node's clock leapt ahead: it was set",
)
_NOT_NEWER = fixed(
    "node.not_newer",
    "its stamps run backwards: what is older than what came before it is passed over",
)
_FRAMES_LOST = fixed(
    "node.frames_lost",
    "the node's numbers have gaps: this machine, or the way, is too slow for it",
)
# Reasons of the known nodes; other reasons are shown as the node words them.
_REFUSED = {
    "node_refused.stale": _REFUSED_LATE,
    "node_refused.limits": _REFUSED_LIMITS,
    "node_refused.dimension": _REFUSED_DIMENSION,
    "node_refused.not_finite": _REFUSED_NOT_FINITE,
    "node_refused.malformed": _REFUSED_MALFORMED,
    "node_refused.collecting": _REFUSED_COLLECTING,
}
_QUEUED_FRAMES = 4
_WAKE_MS = 50  # time until the reader thread notices that it must end [ms]
_REOPEN_S = 1.0
_BACKWARDS_S = 0.1  # [s]; one socket keeps the order, so an earlier stamp means another clock


class NodeSource(Source):
    """SUB socket that a thread empties continuously, so that no frame ages in a queue.

    The newest frame is the one that arrived last, whatever time the node stamped on it. After a restart a node may
    stamp smaller times than before, and its frames are nevertheless used at once. `Observation.sequence` counts the
    usable frames since `connect`, independent of the node's own numbers. Errors in the thread are counted; if the
    socket fails, the thread opens another.
    """

    _told: str  # last reported reason why no frame arrives

    def __init__(self, config: NodeSettings, robot: Robot, clock: Clock) -> None:
        self._endpoint = config.sub_endpoint
        self._detect_frozen = config.detect_frozen
        self._simulated = config.simulated
        self._stalled_after = config.stalled_after_s
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
        """Start to listen.

        ZMQ connects to the node as soon as it is there. Raises TransportError for a bad endpoint.
        """
        self.close()
        self._forget()
        self._ending.clear()
        try:
            socket = self._open_subscriber()
        except zmq.ZMQError as error:
            raise TransportError(_CANNOT_LISTEN(endpoint=self._endpoint, error=error)) from error
        self._thread = threading.Thread(target=self._read, args=(socket,), name="node-source", daemon=True)
        self._thread.start()

    def receive(self, timeout: float) -> Observation | None:
        """Return the newest complete frame that was not delivered yet, as RGB; None after `timeout` [s] without one."""
        with self._changed:
            self._changed.wait_for(lambda: self._newest is not None, timeout)
            newest, self._newest = self._newest, None
        return None if newest is None else _observation(*newest)

    def close(self) -> None:
        """Stop listening and end the thread."""
        self._ending.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def faults(self) -> dict[str, int]:
        """Return the number of refused messages by reason, and these counts:

        `clock_backwards` and `clock_forwards` count jumps of the node's clock.
        `frames_lost` counts gaps in the node's own numbers.
        `frozen_<camera>` counts how often that camera's picture stayed the same for too long.
        `truth_ignored` is 1 if a node that is not declared simulated sends the ground truth of a bench.
        `drives_unusable` counts messages with an unreadable drive state.
        `node_refused.<reason>` counts commands that the node itself refused.
        """
        with self._changed:
            refused = {f"node_refused.{reason}": n for reason, n in self._status.refused.items()}
            return dict(self._faults) | refused

    def describe_fault(self, fault: str) -> str:
        """Return a sentence about the latest occurrence of a fault; if the node refused commands, an explanation of its
        reason.
        """
        if fault == "node_refused.other_master":
            return _SEVERAL_CLIENTS(client=self._status.master)
        if fault in _REFUSED:
            return _REFUSED[fault]
        with self._changed:
            return self._sentences.get(fault, "")

    def pop_events(self) -> list[Event]:
        """Return one event for each new reason why no usable frame arrives."""
        now = self._clock.now()
        with self._changed:
            silent = now - self._usable_at
            refused = self._refused if self._heard_at > self._usable_at else None
            stalled = silent > self._stalled_after
            reason = "" if not stalled else refused[0] if refused else self._silence_reason()
            fresh = reason not in ("", self._told)
            self._told = reason
        if not fresh:
            return []
        return [Event("source_waiting", self._no_frame_reason(silent, refused and refused[1]), now)]

    @property
    def last_fault(self) -> str:
        """Sentence about the newest fault; "" if there was none."""
        return self._last_fault

    @property
    def status(self) -> NodeStatus:
        """Status in the node's newest usable message."""
        return self._status

    def _forget(self) -> None:
        self._map = ClockMap(tolerance=_BACKWARDS_S)
        self._stamp = -math.inf  # stamp of the newest message
        self._freshness = FrozenCameraDetector()
        self._faults: Counter[str] = Counter()
        self._sentences: dict[str, str] = {}  # newest sentence by fault
        self._last_fault = ""
        self._status = NodeStatus()
        self._count = 0
        self._peer_sequence: int | None = None
        self._newest = None
        self._usable_at = self._heard_at = self._clock.now()
        self._refused: tuple[str, str] | None = None  # fault and text of the newest refused message
        self._told = ""

    def _silence_reason(self) -> str:
        """Return why no message arrives; each reason is one event."""
        return "silent"

    def _no_frame_reason(self, silent: float, refusal: str | None) -> str:
        fields = {"endpoint": self._endpoint, "seconds": silent}
        if refusal:
            return _NOTHING_USABLE(**fields, why=refusal)
        return _STOPPED(**fields) if self._count else _NEVER_CAME(**fields)

    def _open_subscriber(self) -> zmq.Socket[bytes]:
        """Return a socket that receives from the node. Raises ZMQError."""
        options: dict[int, int | bytes] = {
            zmq.RCVHWM: _QUEUED_FRAMES,
            zmq.MAXMSGSIZE: MESSAGE_LIMIT,
            zmq.SUBSCRIBE: b"",
        }
        return node_link.open_socket(zmq.SUB, self._endpoint, options)

    def _read(self, socket: zmq.Socket[bytes] | None) -> None:
        """Run the reader thread. No error may end it, because nothing else listens to the node."""
        while not self._ending.is_set():
            try:
                if socket is None:
                    socket = self._open_subscriber()
                if socket.poll(_WAKE_MS):
                    self._handle_messages(_drain(socket), self._clock.now())
            except zmq.ZMQError as error:
                self._count_fault("socket_failed", f"the socket failed and is opened anew: {error}")
                if socket is not None:
                    socket.close()
                    socket = None
                self._ending.wait(_REOPEN_S)
            except Exception as error:
                self._count_internal_error(error)
                self._ending.wait(_WAKE_MS / 1000)  # a lasting error must not spin
        if socket is not None:
            socket.close()

    def _handle_messages(self, payloads: list[memoryview], arrived: float) -> None:
        """Store the newest usable message of `payloads`; an unusable newer one does not replace a usable older one."""
        self._heard_at = arrived
        for payload in reversed(payloads):
            try:
                frame = self._messages.read(payload)
            except MessageRefused as error:
                self._count_fault(error.fault, str(error))
                self._refused = error.fault, str(error)
            else:
                if self._store_frame(frame, arrived):
                    return

    def _store_frame(self, frame: NodeFrame, arrived: float) -> bool:
        """Store the frame for `receive`; return False if its stamp is older than that of an earlier frame."""
        for fault, text in frame.remarks:
            self._count_fault(fault, text)
        if frame.truth is not None and not self._simulated:
            self._ignore_truth()
            frame = replace(frame, truth=None)
        time = self._mapped(frame.stamp, arrived)
        if time is None:
            with self._changed:
                self._count_lost(frame.sequence)
            self._count_fault("not_newer", _NOT_NEWER)
            self._refused = "not_newer", _NOT_NEWER
            return False
        captured = self._captured(frame, time)
        with self._changed:
            self._count_lost(frame.sequence)
            self._count += 1
            self._usable_at = arrived
            self._status = frame.status
            self._newest = (self._count, arrived, captured, frame)
            self._changed.notify_all()
        return True

    def _ignore_truth(self) -> None:
        """Count a fault for ground truth that the deployment does not declare, but only once.

        Every message of such a node contains ground truth, so that a count per message would say nothing.
        """
        if "truth_ignored" not in self._faults:
            text = _TRUTH_UNDECLARED
            self._count_fault("truth_ignored", text)

    def _captured(self, frame: NodeFrame, time: float) -> dict[str, float]:
        """Return the capture time of each stream [s].

        It is `time`, except for a picture that has not changed: the capture time of such a picture is the time at which
        the picture first appeared.
        """
        times = dict.fromkeys(["joints", *(["eef"] if frame.eef is not None else []), *frame.pictures], time)
        if self._detect_frozen:
            times |= self._freshness.captured(frame.pictures, time)
            for camera in self._freshness.newly_frozen(time):
                self._count_fault(f"frozen_{camera}", _FROZEN_PICTURE(camera=camera, seconds=FROZEN_S))
        return times

    def _mapped(self, stamp: float, arrived: float) -> float | None:
        """Return the node's stamp on our clock; None if it is older than an earlier stamp.

        If the node's clock jumps, the jump is counted, the map starts anew, and the stamp is accepted.
        """
        restarts, leaps = self._map.restarts, self._map.leaps
        time = self._map.map(stamp, arrived)
        if self._map.restarts > restarts:
            self._count_fault("clock_backwards", _CLOCK_BACK)
        if self._map.leaps > leaps:
            self._count_fault("clock_forwards", _CLOCK_AHEAD)
        if self._map.restarts == restarts and stamp < self._stamp:
            return None
        self._stamp = stamp
        return time

    def _count_lost(self, sequence: int | None) -> None:
        if sequence is not None and self._peer_sequence is not None and sequence > self._peer_sequence + 1:
            self._faults["frames_lost"] += sequence - self._peer_sequence - 1
            self._sentences["frames_lost"] = _FRAMES_LOST
        self._peer_sequence = sequence

    def _count_fault(self, fault: str, text: str) -> None:
        with self._changed:
            self._faults[fault] += 1
            self._sentences[fault] = text
            self._last_fault = f"{self._endpoint}: {text}"

    def _count_internal_error(self, error: Exception) -> None:
        text = f"reading failed: {type(error).__name__}: {error}"
        if not self._last_fault.endswith(text):  # log once, not thirty times a second
            log.error("%s: %s", self._endpoint, text, exc_info=error)
        self._count_fault("reader_failed", text)


def _drain(socket: zmq.Socket[bytes]) -> list[memoryview]:
    """Return all messages that have arrived, oldest first, up to a limit, so that a flood cannot block the thread.

    The messages stay in ZMQ's own buffers without a copy; decoding copies the parts that it needs.
    """
    payloads: list[memoryview] = []
    with contextlib.suppress(zmq.Again):
        while len(payloads) < 4 * _QUEUED_FRAMES and readable(socket):
            payloads.append(socket.recv(zmq.NOBLOCK, copy=False).buffer)
    return payloads


def _observation(
    sequence: int, arrived: float, captured: Mapping[str, float], frame: NodeFrame
) -> Observation:
    pictures = frame.pictures
    if frame.encoding == "bgr":
        pictures = {key: _bgr_to_rgb(picture) for key, picture in pictures.items()}
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
        environment_state=frame.environment_state,
    )


def _bgr_to_rgb(bgr: UInt8) -> UInt8:
    """Convert BGR to RGB with cv2, which is ten times as fast as numpy.

    cv2 is imported only here, because control locks everything that it imports into memory.
    """
    import cv2

    rgb = np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)
    rgb.flags.writeable = False
    return rgb
