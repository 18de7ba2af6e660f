"""Check which process listens on a loopback port, from the kernel's tables and without a connection.

A connection would reach the policy server, and could not distinguish our process from another one on that port.
"""

from __future__ import annotations

import os
import socket
import sys
from pathlib import Path

_LISTEN = "0A"
_LOOPBACK = int.from_bytes(socket.inet_aton("127.0.0.1"), sys.byteorder)


def is_listening(pid: int, port: int) -> bool:
    """Return True if the process `pid`, and no other, accepts connections on 127.0.0.1:`port`."""
    sockets = _sockets(pid)
    return any(f"socket:[{inode}]" in sockets for inode in _listeners(pid, port)) if sockets else False


def _listeners(pid: int, port: int) -> list[str]:
    """Return inodes of the sockets that listen there, in the process's own network namespace."""
    here = f"{_LOOPBACK:08X}:{port:04X}"
    try:
        rows = [line.split() for line in Path(f"/proc/{pid}/net/tcp").read_text("ascii").splitlines()[1:]]
    except OSError:  # it has ended
        return []
    return [row[9] for row in rows if row[1] == here and row[3] == _LISTEN]


def _sockets(pid: int) -> set[str]:
    found = set()
    try:
        for entry in os.scandir(f"/proc/{pid}/fd"):
            try:
                found.add(os.readlink(entry.path))
            except OSError:  # closed meanwhile
                continue
    except OSError:  # it has ended
        return set()
    return found
