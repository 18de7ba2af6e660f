"""ZMQ sockets of an execution node: one publishes observations, one receives commands."""

from __future__ import annotations

import contextlib
import ipaddress

import zmq

from runtime.core.errors import SetupError

_QUEUED_FRAMES = 4
_QUEUED_COMMANDS = 64  # few, because commands that queue while the node is suspended are old when it resumes
_DRAINED_COMMANDS = 1000  # per tick; a flood must not stop publishing


class Sockets:
    """Publisher of observations and subscriber of commands, both bound on construction.

    Raises:
        SetupError: If an address is in use, or reachable from other machines without `insecure`.
    """

    def __init__(self, observations: str, commands: str, insecure: bool) -> None:
        self._publisher = bound(zmq.PUB, observations, insecure)
        try:
            self._subscriber = bound(zmq.SUB, commands, insecure)
        except SetupError:
            self._publisher.close(linger=0)
            raise
        self._subscriber.setsockopt(zmq.SUBSCRIBE, b"")

    @property
    def addresses(self) -> dict[str, str]:
        """Bound addresses of the sockets."""
        return {"obs_endpoint": address(self._publisher), "action_endpoint": address(self._subscriber)}

    def received(self, wait_ms: int = 0) -> list[bytes]:
        """Return the commands received since the last call, in order; at most _DRAINED_COMMANDS.

        Wait at most `wait_ms` for the first.
        """
        payloads: list[bytes] = []
        if wait_ms:
            self._subscriber.poll(wait_ms)
        with contextlib.suppress(zmq.Again):
            while len(payloads) < _DRAINED_COMMANDS:
                payloads.append(self._subscriber.recv(zmq.NOBLOCK))
        return payloads

    def publish(self, payload: bytes) -> None:
        """Send one observation; it is dropped if subscribers are too slow, because the next one is newer."""
        # libzmq notices deliveries only once a millisecond, and drops messages while a queue appears full; polling
        # makes it process pending notices.
        self._publisher.poll(0, zmq.POLLOUT)
        with contextlib.suppress(zmq.Again):
            self._publisher.send(payload, zmq.NOBLOCK, copy=False)

    def close(self) -> None:
        """Close both sockets; safe to call twice."""
        for socket in (self._publisher, self._subscriber):
            socket.close(linger=0)


def bound(kind: int, endpoint: str, insecure: bool) -> zmq.Socket[bytes]:
    """Return a socket of type `kind`, bound to `endpoint`.

    Raises:
        SetupError: If the address is in use, or reachable from other machines without `insecure`.
    """
    if not insecure and not is_loopback(endpoint):
        raise SetupError(
            f"{endpoint} can be reached from other machines; add --insecure-link, or in a file insecure_link = true, "
            "to allow it"
        )
    socket: zmq.Socket[bytes] = zmq.Context.instance().socket(kind)
    socket.setsockopt(zmq.SNDHWM, _QUEUED_FRAMES)
    socket.setsockopt(zmq.RCVHWM, _QUEUED_COMMANDS)
    try:
        socket.bind(endpoint)
    except zmq.ZMQError as error:
        socket.close(linger=0)
        raise SetupError(f"cannot bind {endpoint}: {error}") from error
    return socket


def address(socket: zmq.Socket[bytes]) -> str:
    """Return the bound address of a socket."""
    raw = socket.getsockopt(zmq.LAST_ENDPOINT)
    assert isinstance(raw, bytes)
    return raw.rstrip(b"\0").decode()


def is_loopback(endpoint: str) -> bool:
    """Return True if the endpoint cannot be reached from another machine."""
    scheme, _, address = endpoint.partition("://")
    if scheme in {"ipc", "inproc"}:
        return True
    host = address.rpartition(":")[0].strip("[]")
    if host == "localhost":
        return True
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return False
