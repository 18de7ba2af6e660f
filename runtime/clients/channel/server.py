"""Socket of the channel: receives messages of any number of scripts, passes them to workers, sends the answers."""

from __future__ import annotations

import os
import threading
import time
import uuid
from collections.abc import Callable
from typing import Any

import zmq

from runtime.clients.channel import json_answers
from runtime.clients.channel.executor import CommandExecutor
from runtime.clients.channel.holder_names import HolderNames
from runtime.clients.channel.message import LARGEST, Malformed, Message, read
from runtime.clients.channel.outcomes import Outcomes
from runtime.clients.channel.request_worker import Job, RequestWorker
from runtime.clients.channel.scripts import ScriptActivity
from runtime.clients.channel.stop_handlers import (
    EStopHandler,
    StopHandler,
    is_estop,
    is_stop,
)
from runtime.clients.client import StationClient
from runtime.core.errors import TransportError

HOST = "127.0.0.1"
_REPLIES = "inproc://channel-replies-{}"
_END_S = 1.0
_AT_ONCE = 64  # messages per call, so that a flood does not delay answers


class ChannelServer:
    """Server on the loopback address only. Stops have workers of their own, which nothing else delays."""

    def __init__(
        self,
        context: zmq.Context[Any],
        port: int,
        names: HolderNames,
        silence_s: float,
        open_client: Callable[[str], StationClient],
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._names, self._lives, self._stops = names, ScriptActivity(now), 0
        self._socket, self.endpoint = _listening(context, port)
        self._context, self._inbox = context, _REPLIES.format(uuid.uuid4())
        self._replies = context.socket(zmq.PULL)
        self._replies.linger = 0
        self._replies.bind(self._inbox)
        self._local = threading.local()
        outcomes = Outcomes()
        executor = CommandExecutor(open_client, self._lives, outcomes, silence_s)
        self._desk = self._lane("executor", executor, executor.poll)
        self._brake = self._lane("brake", StopHandler(open_client, self._lives, outcomes))
        self._estop = self._lane("estop", EStopHandler(open_client, outcomes))

    def _lane(self, name: str, clerk: Any, keep: Callable[[], None] | None = None) -> RequestWorker:
        return RequestWorker(f"channel-{name}", clerk, self._reply, lambda: self._stops, keep)

    def _reply(self, address: list[bytes], answer: dict[str, Any]) -> None:
        """Pass an answer from a worker's thread to the server, through a socket of that thread."""
        if not hasattr(self._local, "socket"):
            self._local.socket = self._context.socket(zmq.PUSH)
            self._local.socket.linger = 0
            self._local.socket.connect(self._inbox)
        self._local.socket.send_multipart([*address, json_answers.dumps(answer)])

    def serve(self, timeout: float) -> None:
        """Wait up to `timeout` [s], then send waiting answers and pass on waiting messages, bounded per call."""
        poller = zmq.Poller()
        poller.register(self._socket, zmq.POLLIN)
        poller.register(self._replies, zmq.POLLIN)
        poller.poll(int(timeout * 1000))
        for act, socket in ((self._send, self._replies), (self._route, self._socket)):
            for _ in range(_AT_ONCE):
                frames = _next(socket)
                if frames is None:
                    break
                act(frames)

    def _route(self, frames: list[bytes]) -> None:
        """Pass a message to its worker; answer at once if it cannot be read or the worker's queue is full."""
        end = frames.index(b"", 1) + 1 if b"" in frames[1:] else 1
        address, body = frames[:end], frames[end:]
        try:
            message = read(body)
        except Malformed as fault:
            self._send([*address, json_answers.dumps(json_answers.error_answer(str(fault)))])
            return
        holder = self._names.holder(address[0], message.client)
        if self._names.is_alive(address[0], message, is_stop(message) or is_estop(message)):
            self._lives.record(holder)
        lane = self._lane_of(message)
        if not lane.submit(Job(address, holder, message, time.monotonic(), self._stops)):
            under_way = "so many presses are under way already that this one adds nothing"
            reason = under_way if is_estop(message) else "too many commands wait: not carried out"
            self._send([*address, json_answers.dumps(json_answers.error_answer(reason) | message.echo)])

    def _lane_of(self, message: Message) -> RequestWorker:
        if not is_estop(message) and not is_stop(message):
            return self._desk
        self._stops += 1  # commands that are still waiting become void
        return self._estop if is_estop(message) else self._brake

    def _send(self, frames: list[bytes]) -> None:
        """Send an answer; it is lost if the script has disconnected."""
        self._socket.send_multipart(frames, zmq.NOBLOCK)

    def close(self) -> None:
        """Stop the workers and close the socket; leases still held expire by themselves."""
        for lane in (self._desk, self._brake, self._estop):
            lane.end(_END_S)
        self._socket.close()
        self._replies.close()


def _next(socket: Any) -> list[bytes] | None:
    try:
        frames: list[bytes] = socket.recv_multipart(zmq.NOBLOCK)
    except zmq.Again:
        return None
    return frames


def _listening(context: zmq.Context[Any], port: int) -> tuple[Any, str]:
    """Return a bound socket and its endpoint. Raises: TransportError if the port is in use."""
    socket = context.socket(zmq.ROUTER)
    socket.linger = 0
    socket.set(
        zmq.MAXMSGSIZE, 16 * LARGEST
    )  # above LARGEST, so that a message slightly too large gets an answer
    try:
        socket.bind(f"tcp://{HOST}:{port or '*'}")
    except zmq.ZMQError as error:
        socket.close()
        raise TransportError(
            f"the control channel cannot listen on {HOST}:{port}: {os.strerror(error.errno or 0)}; "
            "name another port with control_channel.port"
        ) from None
    return socket, socket.last_endpoint.decode()
