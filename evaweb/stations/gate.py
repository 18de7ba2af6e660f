"""Process to which stations on other computers connect; the database decides which keys it admits."""

from __future__ import annotations

import fcntl
import json
import logging
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import MappingProxyType

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from django.conf import settings
from django.db import Error, close_old_connections

from evaweb.core.errors import EvaError
from evaweb.stations.enrolment import key_enrol, keys_allowed
from runtime.core import logs, process_limits
from runtime.ipc.bus import TransportError
from runtime.link import key_files
from runtime.link.admission import Allowed, AllowList
from runtime.link.gate import Gate
from runtime.link.incoming import Incoming, Owner, ReadBack
from runtime.link.key_files import ConfigurationError
from runtime.link.wire import Enrolled
from runtime.recording.files import write_atomic

log = logging.getLogger(__name__)
_LOOK_S = 0.5
_TURN_S = 0.001  # switch interval of the interpreter: bounds the delay of a stop by other threads


class GateError(EvaError):
    """Error if the gate cannot start or continue; the message states the reason."""


class Keys:
    """Keys of stations that may connect to the gate, read from the database twice a second.

    While the database does not answer, the last result counts. The result is also stored in a file: linked stations can
    be stopped even if the gate starts without the database.
    """

    def __init__(self, data: Path) -> None:
        self._path = key_files.folder(data) / "allowed.json"
        self._failing = False
        self.list = AllowList(self._kept())
        self.poll()

    def poll(self) -> None:
        """Read the keys once; thread-safe."""
        try:
            allowed = keys_allowed()
            self._failing = False
        except Error as error:
            if not self._failing:
                log.warning("who may connect is as it was, the database does not say: %s", error)
            self._failing = True
            return
        finally:
            close_old_connections()
        if allowed != self.list.now:
            self.list.now = allowed
            self._keep(allowed)

    def follow(self, ended: threading.Event) -> None:
        """Read the keys periodically until `ended` is set."""
        while not ended.wait(_LOOK_S):
            try:
                self.poll()
            except Exception:  # otherwise this thread would end, and withdrawn keys would stay admitted
                log.exception("who may connect is as it was")

    def _keep(self, allowed: Allowed) -> None:
        content = {key: sorted(names) for key, names in allowed.stations.items()}
        try:
            write_atomic(self._path, json.dumps(content).encode())
        except OSError as error:
            log.error("who may connect is not kept in %s: %s", self._path, error)

    def _kept(self) -> Allowed:
        with suppress(OSError, ValueError, AttributeError, TypeError):
            by_key = json.loads(self._path.read_text("utf-8"))
            return Allowed(MappingProxyType({key: frozenset(names) for key, names in by_key.items()}))
        return Allowed()


def serve(where: tuple[str, int, int], lifeline: bool, owner: Owner, read_back: ReadBack) -> None:
    """Serve until SIGINT, SIGTERM or, with `lifeline`, the end of standard input; print the address as JSON.

    `where` is the host to listen on and its two ports; port 0 chooses a free port. `owner` returns the name of the
    station that owns an offered episode, and `read_back` reads a file that is in the lab's store alone.

    Raises: GateError.
    """
    try:
        with _lock_gate(key_files.folder(settings.DATA_DIR) / "gate.lock"):
            _serve(where, lifeline, owner, read_back)
    except (TransportError, ConfigurationError) as fault:
        raise GateError(str(fault)) from None


@contextmanager
def _lock_gate(path: Path) -> Iterator[None]:
    """Lock the lab's folders of remote stations: two gates would both store the stations' data."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    with path.open("a+", encoding="utf-8") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            lock.seek(0)
            raise GateError(
                f"a gate of {settings.DATA_DIR} is already running (process {lock.read().strip() or '?'}): end it first"
            ) from None
        lock.truncate(0)
        lock.write(str(os.getpid()))
        lock.flush()
        yield


def _serve(where: tuple[str, int, int], lifeline: bool, owner: Owner, read_back: ReadBack) -> None:
    logs.configure_logging("gate")
    process_limits.raise_file_limit()
    sys.setswitchinterval(_TURN_S)
    data = settings.DATA_DIR
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, frame: ended.set())
    keys = Keys(data)
    tokens = key_files.tokens_key(data)
    incoming = Incoming(data, owner, settings.EVA_RESERVE_BYTES, read_back)
    enrol = _enroller(keys, tokens)
    gate = Gate(data, key_files.lab_key(data), tokens, keys.list, enrol, where, incoming=incoming)
    threading.Thread(target=keys.follow, args=(ended,), name="keys", daemon=True).start()
    if lifeline:
        threading.Thread(target=_watch, args=(ended,), name="lifeline", daemon=True).start()
    url = f"tcp://{where[0]}:{gate.port}"
    print(json.dumps({"url": url, "port": gate.port, "second_port": gate.second_port}), flush=True)
    try:
        while not ended.is_set():
            gate.turn()
    finally:
        gate.close()


def _enroller(keys: Keys, tokens: bytes) -> Callable[[str, str, str], Enrolled | str]:
    public = Ed25519PrivateKey.from_private_bytes(tokens).public_key().public_bytes_raw()

    def enrol(digest: str, key: str, computer: str) -> Enrolled | str:
        try:
            station = key_enrol(digest=digest, key=key, computer=computer)
        except EvaError as fault:
            return str(fault)
        finally:
            close_old_connections()
        keys.poll()  # admit the new key before the computer connects with it
        return Enrolled(station.name, socket.gethostname(), public, 0)

    return enrol


def _watch(ended: threading.Event) -> None:
    """Set `ended` when standard input ends: the parent process holds its other end."""
    while os.read(0, 4096):
        pass
    ended.set()
