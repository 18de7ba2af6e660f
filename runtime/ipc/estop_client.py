"""Delivery of urgent commands, each over a connection of its own that follows the socket if its path changes."""

from __future__ import annotations

import time
from typing import Any

import zmq

from runtime.core.errors import TransportError
from runtime.core.sentences import Pattern
from runtime.ipc.bus import CommandClient, Endpoints, Key
from runtime.ipc.endpoints import LOOK_S, connection_problem
from runtime.ipc.messages import Ack, Command

_NO_ANSWER = Pattern(
    "bus.no_answer_because", "no answer to {kind} within {seconds:g} s: outcome unknown{why}"
)
_BECAUSE = Pattern("bus.because", "; {why}")
_NOT_SENT = Pattern("bus.not_sent", "{kind} was not sent: {why}")
_NO_SOCKET = Pattern("bus.no_socket", "{process} has no socket {name!r}: start the station again")

_AGAIN_S = 0.02


class NotSent(TransportError):
    """Error about a command that was not executed: no process was listening during the whole timeout."""


class NoAnswer(TransportError):
    """Error about a command without an answer: it may have been executed. `why` is the reason, as far as known."""

    def __init__(self, kind: str, seconds: float, why: str) -> None:
        self.why = _BECAUSE(why=why) if why else ""
        super().__init__(_NO_ANSWER(kind=kind, seconds=seconds, why=self.why))


def send_urgent(
    context: zmq.Context[Any],
    endpoints: Endpoints,
    where: tuple[str, str],
    command: Command,
    timeout: float,
    key: Key | None = None,
) -> Ack:
    """Send a command until it is answered; `where` is process and socket, as in ("guard", "estop").

    It is sent again whenever the socket's path has changed; the file with the path may be updated late.

    Returns:
        The answer.

    Raises:
        NotSent: no process listened; the message advises what to do.
        NoAnswer: no answer within `timeout` [s]; the message advises what to do.
        CodecError: the command is too large.
        TransportError: the station has no such process or socket.
    """
    deadline = time.monotonic() + timeout
    client, place, received, reason = None, "", False, ""
    try:
        while True:
            try:
                current = _current_endpoint(endpoints, where, place)
            except TransportError:
                if time.monotonic() >= deadline or not endpoints.is_listening(where[1]):
                    raise
                time.sleep(_AGAIN_S)  # its process rewrites the file within two LOOK_S periods
                continue
            if client is None or current != place:
                if client is not None:
                    client.close()
                client, place = CommandClient(context, current, key, endpoints.owner), current
                client.send(command)
            reason = connection_problem(place)
            received = received or not reason
            answer = client.receive_answer(command, min(LOOK_S, max(0.0, deadline - time.monotonic())))
            if answer is not None:
                return answer
            reason = client.strangers or reason
            if time.monotonic() >= deadline:
                break
    finally:
        if client is not None:
            client.close()
    if not received:
        raise NotSent(_NOT_SENT(kind=command.kind, why=reason))
    raise NoAnswer(command.kind, timeout, reason)


def _current_endpoint(endpoints: Endpoints, where: tuple[str, str], before: str) -> str:
    """Return the current endpoint of a socket from its process's file; if that has none, return `before`.

    Raises:
        TransportError: there is none, and `before` is "".
    """
    process, name = where
    try:
        return str(endpoints.read(process)[name])
    except KeyError:
        if not before:
            raise TransportError(_NO_SOCKET(process=process, name=name)) from None
    except TransportError:
        if not before:
            raise
    return before
