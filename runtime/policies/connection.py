"""A TCP connection within a deadline that holds for everything, and that can be given up from another thread."""

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

_SPELL_MS = 20  # how soon a connection that is being made notices that nobody wants it any more


def open_connection(
    url: str, host: str, port: int, deadline: float, seconds: float, require_wanted: Callable[[], None]
) -> socket.socket:
    """As `reach`, with errors that name `url`, and the `seconds` that there were until the deadline.

    PortClosedError where the machine answers and nobody listens, UnreachableError where nothing answers.
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
    """A connection to the first address of the host that takes one; OSError of the last one else.

    `deadline` is on the monotonic clock, past it TimeoutError. `require_wanted` raises where the caller was told
    to give up; it is asked every few milliseconds.
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
    """Addresses of the host's name, resolved in a thread because the resolver itself knows no deadline."""
    found: queue.SimpleQueue[list[Address] | OSError] = queue.SimpleQueue()

    def resolve() -> None:
        try:
            found.put(list(socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)))
        except OSError as error:
            found.put(error)
        except UnicodeError as error:
            found.put(socket.gaierror(socket.EAI_NONAME, str(error)))

    threading.Thread(target=resolve, name="resolver", daemon=True).start()
    try:
        addresses = found.get(timeout=max(0.0, seconds))
    except queue.Empty as error:
        raise TimeoutError(f"the name {host} was not resolved") from error
    if isinstance(addresses, OSError):
        raise addresses
    return addresses
