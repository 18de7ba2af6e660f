"""Temporary private ROS domain: UDP on loopback, on ports that no other process uses at the same time."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Iterator

from runtime.core.errors import SetupError

_DOMAINS = range(1, 100)  # higher domains overlap the system's ephemeral ports
_FIRST, _EACH = 7400, 250  # first port, ports per domain: RTPS 2.5, section 9.6.2


@contextlib.contextmanager
def free_domain() -> Iterator[int]:
    """Yield a domain id that no other process uses; a bound TCP port in the domain's range marks it as used.

    Raises:
        SetupError: If all domains are in use.
    """
    start = os.getpid()
    for offset in _DOMAINS:
        domain = _DOMAINS[(start * 7 + offset) % len(_DOMAINS)]
        first = _FIRST + _EACH * domain
        with contextlib.ExitStack() as stack:
            try:
                mark = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_STREAM))
                mark.bind(("127.0.0.1", first + _EACH - 1))
                for port in (first + 10, first + 11, first + 12, first + 13):
                    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                        probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            yield domain
            return
    raise SetupError(f"the ROS domains {_DOMAINS[0]} to {_DOMAINS[-1]} of this machine are all in use")
