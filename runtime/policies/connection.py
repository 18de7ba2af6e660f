"""TCP connections with one deadline for name resolution and connecting; another thread can abort them."""

from __future__ import annotations

import contextlib
import errno
import os
import queue
import select
import socket
import threading
import time
from collections.abc import Callable
from typing import Any

from runtime.core.errors import PortClosedError, UnreachableError

Address = tuple[Any, ...]
Place = tuple[str, int]  # host and port
Dial = Callable[[], Place]

_SPELL_MS = 20  # period of the check for an abort while connecting [ms]


def open_connection(
    url: str, host: str, port: int, deadline: float, seconds: float, require_wanted: Callable[[], None]
) -> socket.socket:
    """Return a connection as `connect_any` does, with errors that name `url`.

    Args:
        url: Address of the policy server, for messages.
        host: Name or address.
        port: TCP port.
        deadline: Time limit on the monotonic clock [s].
        seconds: Time allowed for connecting [s], for messages.
        require_wanted: Function that raises if the caller was aborted; called every few milliseconds.

    Raises:
        PortClosedError: The machine responds, but nothing listens on the port.
        UnreachableError: The machine does not respond, its name is unknown, or the connection failed in another
            way.
    """
    try:
        return connect_any(host, port, deadline, require_wanted)
    except ConnectionRefusedError as error:
        raise PortClosedError(
            f"no policy server listens at {url}: start it, or correct policy.url"
        ) from error
    except socket.gaierror as error:
        raise UnreachableError(f"the host of {url} is not known: correct policy.url ({error})") from error
    except TimeoutError as error:
        raise UnreachableError(
            f"{url} was not reached within {seconds:g} s: the host is off, or something on the way drops what is sent "
            "to it; correct policy.url, or open the way"
        ) from error
    except OSError as error:
        raise UnreachableError(
            f"the connection to {url} failed ({error}): correct policy.url, or open the way"
        ) from error


def connect_any(host: str, port: int, deadline: float, require_wanted: Callable[[], None]) -> socket.socket:
    """Return a connection to the first address of the host that accepts one.

    Args:
        host: Name or address.
        port: TCP port.
        deadline: Time limit on the monotonic clock [s].
        require_wanted: Function that raises if the caller was aborted; called every few milliseconds.

    Raises:
        OSError: The error of the last address; TimeoutError after the deadline.
    """
    refusal: OSError = OSError(f"{host} has no address")
    for family, kind, protocol, _, address in _addresses(host, port, deadline - time.monotonic()):
        with contextlib.ExitStack() as stack:
            wire = stack.enter_context(socket.socket(family, kind, protocol))
            try:
                _try_address(wire, address, deadline, require_wanted)
            except OSError as error:
                refusal = error
            else:
                stack.pop_all()
                return wire
    raise refusal


def _try_address(
    wire: socket.socket, address: Address, deadline: float, require_wanted: Callable[[], None]
) -> None:
    wire.setblocking(False)
    state = wire.connect_ex(address)
    opening = select.poll()
    opening.register(wire, select.POLLOUT)
    while state == errno.EINPROGRESS:
        require_wanted()
        if time.monotonic() >= deadline:
            raise TimeoutError(f"{address} did not answer")
        if opening.poll(_SPELL_MS):
            state = wire.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
    if state:
        raise OSError(state, os.strerror(state))
    wire.setblocking(True)


def _addresses(host: str, port: int, seconds: float) -> list[Address]:
    """Return the addresses of the host.

    They are resolved in a thread, because the system's resolver has no deadline.
    """
    results: queue.SimpleQueue[list[Address] | OSError] = queue.SimpleQueue()

    def resolve() -> None:
        try:
            results.put(list(socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)))
        except OSError as error:
            results.put(error)
        except UnicodeError as error:
            results.put(socket.gaierror(socket.EAI_NONAME, str(error)))

    threading.Thread(target=resolve, name="resolver", daemon=True).start()
    try:
        addresses = results.get(timeout=max(0.0, seconds))
    except queue.Empty as error:
        raise TimeoutError(f"the name {host} was not resolved") from error
    if isinstance(addresses, OSError):
        raise addresses
    return addresses
