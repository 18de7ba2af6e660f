"""Enrolment of a robot's computer as a station of a lab, with its own key and the code that the lab shows."""

from __future__ import annotations

import re
import socket
import time
from pathlib import Path
from typing import Any

import zmq
from zmq.utils.monitor import recv_monitor_message

from runtime.core.errors import CodecError, ConfigurationError, TransportError
from runtime.link.codes import Code
from runtime.link.key_files import KeyPair, KnownLab, save_lab
from runtime.link.line import dialled, ended
from runtime.link.release import version
from runtime.link.wire import RELEASE, Bye, Enrol, Enrolled, read, write

_POLL_MS = 100
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,62}")  # allowed name of a station, which becomes a folder
_HEARD_S, _AGAIN_S = (
    2.0,
    0.3,
)  # [s] until the gate knows a code just shown; between two tries
_NOT_OPEN = Bye("no code is open there: have the administration show a new one")


def address_of(given: str) -> tuple[str, int]:
    """Return host and port of the lab. Raises: ConfigurationError."""
    host, _, port = given.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ConfigurationError(
            f"the address {given!r:.80}; allowed: HOST:PORT, as the administration shows it"
        )
    return host.strip("[]"), int(port)


def enrol(data: Path, address: str, code: Code, key: KeyPair, timeout: float = 10.0) -> KnownLab:
    """Enrol this computer with the lab at `address` and write the station's record of the lab.

    If the lab does not know the code yet, the attempt is repeated for `_HEARD_S`.

    Args:
        timeout: Longest wait for an answer [s], per attempt.

    Raises:
        ConfigurationError: The lab refuses, or the address or the name that it assigns is invalid.
        TransportError: There is no readable answer.
    """
    host, port = address_of(address)
    displayed_host = f"[{host}]" if ":" in host else host
    context: zmq.Context[Any] = zmq.Context()
    heard_by = time.monotonic() + _HEARD_S
    try:
        answer = _exchange(context, f"tcp://{displayed_host}:{port}", code, key, timeout)
        while answer == _NOT_OPEN and time.monotonic() < heard_by:
            time.sleep(_AGAIN_S)
            answer = _exchange(context, f"tcp://{displayed_host}:{port}", code, key, timeout)
    finally:
        context.destroy(linger=0)
    if isinstance(answer, Bye):
        raise ConfigurationError(f"the lab at {address} does not enrol this computer: {answer.why}")
    if not _NAME.fullmatch(answer.station):
        raise ConfigurationError(
            f"the lab at {address} names it {answer.station!r:.80}; allowed: letters, digits, '.', '_' and '-'"
        )
    lab = KnownLab(
        answer.station, answer.lab, host, port, answer.second_port, code.lab.hex(), answer.tokens.hex()
    )
    save_lab(data / "stations" / answer.station, lab)
    return lab


def _exchange(
    context: zmq.Context[Any], endpoint: str, code: Code, key: KeyPair, timeout: float
) -> Enrolled | Bye:
    dealer, monitor = dialled(context, endpoint, code.lab, key)
    dealer.send_multipart(write(Enrol(RELEASE, version(), code.secret, socket.gethostname())))
    deadline = time.monotonic() + timeout
    try:
        while time.monotonic() < deadline:
            over = bool(monitor.poll(0))  # read before the socket: messages sent before the end still count
            if dealer.poll(0 if over else _POLL_MS):
                message, _ = read(dealer.recv_multipart())
                if isinstance(message, Enrolled | Bye):
                    return message
            elif over and recv_monitor_message(monitor)["event"] == zmq.EVENT_HANDSHAKE_FAILED_AUTH:
                return _NOT_OPEN
            elif over:
                break
    except CodecError as error:
        raise TransportError(f"{endpoint}: unreadable answer: {error}") from None
    finally:
        ended(dealer, monitor)
    raise TransportError(
        f"no answer from a lab with the key in this code at {endpoint}: is the address right, "
        "and does its gate run?"
    )
