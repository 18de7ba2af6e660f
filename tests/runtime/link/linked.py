"""A lab's gate and a station's link in this process, over loopback, under the test's hand."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from types import MappingProxyType
from uuid import uuid4

import zmq

from runtime.ipc.bus import CommandClient, Endpoints, Key, Subscriber
from runtime.ipc.messages import Ack, Command
from runtime.link import codes, key_files
from runtime.link.admission import Allowed, AllowList
from runtime.link.gate import Gate
from runtime.link.incoming import Incoming
from runtime.link.key_files import KeyPair, KnownLab
from runtime.link.station import StationLink
from runtime.link.uploads import UploadSettings
from runtime.link.wire import Enrolled
from tests.evaweb.stand_in import FakeStation
from tests.processes import PATIENCE_S, eventually

STATION = "bench-7"


def allowed(*keys: tuple[KeyPair, str], enrolling: bool = False) -> Allowed:
    """These keys, each for a station."""
    names: dict[str, frozenset[str]] = {}
    for key, name in keys:
        names[key.public.hex()] = names.get(key.public.hex(), frozenset()) | {name}
    return Allowed(MappingProxyType(names), enrolling)


class Lab:
    """A lab without a database: its gate in a thread, and what its web would do."""

    def __init__(self, data: Path) -> None:
        self.data = data
        self.key = key_files.lab_key(data)
        self.allowed = AllowList()
        self.codes: dict[str, str] = {}  # digests of open codes, and the station of each
        self.asked: list[tuple[str, str, str]] = []
        self.owners: dict[str, str] = {}  # stations of episodes that its database knows
        self._ended = threading.Event()
        self.begin()

    def begin(self, port: int = 0, second_port: int = 0) -> None:
        """Start the gate."""
        where = ("127.0.0.1", port, second_port)
        self._ended = threading.Event()
        incoming = Incoming(self.data, lambda uuid: self.owners.get(uuid, ""), reserve=0)
        tokens = key_files.tokens_key(self.data)
        self.gate = Gate(self.data, self.key, tokens, self.allowed, self._enrol, where, incoming=incoming)
        self.thread = threading.Thread(target=self._run, args=(self._ended, self.gate), daemon=True)
        self.thread.start()

    def end(self) -> None:
        """End the gate."""
        self._ended.set()
        self.thread.join()

    def _run(self, ended: threading.Event, gate: Gate) -> None:
        try:
            while not ended.is_set():
                gate.turn()
        finally:
            gate.close()

    def _enrol(self, digest: str, key: str, computer: str) -> Enrolled | str:
        self.asked.append((digest, key, computer))
        station = self.codes.pop(digest, None)
        if station is None:
            return "this code is not known, was used, or is too old"
        return Enrolled(station, "the test's lab", self.tokens, 0)

    @property
    def tokens(self) -> bytes:
        """The public key of its tokens."""
        return bytes.fromhex(self.known(STATION).tokens)

    def code(self, station: str) -> codes.Code:
        """An open code for a station."""
        code = codes.fresh(self.key.public)
        self.codes[codes.digest(code.secret)] = station
        return code

    def known(self, station: str) -> KnownLab:
        """What a station that is enrolled knows of it."""
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

        secret = Ed25519PrivateKey.from_private_bytes(key_files.tokens_key(self.data))
        tokens = secret.public_key().public_bytes_raw().hex()
        where = ("127.0.0.1", self.gate.port, self.gate.second_port)
        return KnownLab(station, "the test's lab", *where, self.key.public.hex(), tokens)

    # --- as its web does ---------------------------------------------------------------------------------------

    def folder(self, station: str = STATION) -> Path:
        return self.data / "stations" / station

    def linked(self, station: str = STATION) -> None:
        """Wait until it is."""
        eventually(lambda: station in self.gate.linked(), f"{station} is linked")

    def lost(self, station: str = STATION) -> None:
        """Wait until its link is."""
        eventually(lambda: station not in self.gate.linked(), f"{station} is lost")

    def ask(
        self,
        command: Command,
        place: tuple[str, str] = ("coordinator", "commands"),
        sign: bool = True,
        timeout: float = PATIENCE_S,
    ) -> Ack:
        """The answer to a command that the web signs, or a program of its computer gives."""
        endpoint = str(Endpoints(self.folder()).read(place[0])[place[1]])
        client = CommandClient(zmq.Context.instance(), endpoint, Key(self.folder()) if sign else None)
        try:
            return client.request(command, timeout)
        finally:
            client.close()

    def press(self, sign: bool = True) -> Ack:
        """Press the e-stop."""
        command = Command(str(uuid4()), "estop", {"why": "a test"}, user="ann", holder="ann", role="operator")
        return self.ask(command, ("guard", "estop"), sign)

    def hears(self, process: str, socket: str, stream: str) -> object:
        """The newest of a stream, once there is one."""
        endpoint = str(Endpoints(self.folder()).read(process)[socket])
        subscriber = Subscriber(zmq.Context.instance(), endpoint, stream)
        try:
            return eventually(lambda: subscriber.receive(0.05), stream)
        finally:
            subscriber.close()


class Robot:
    """A robot's computer with a station that has no robot, and its link."""

    def __init__(self, data: Path, lab: Lab, name: str = STATION) -> None:
        self.data, self.lab, self.name = data, lab, name
        self.station = FakeStation(data, name)
        self.key = key_files.make_station_key(data)
        self.link: StationLink | None = None

    def dial(
        self,
        known: Callable[[KnownLab], KnownLab] = lambda lab: lab,
        uploads: UploadSettings | None = None,
    ) -> None:
        """Start the link; with `uploads` its episodes travel."""
        lab = known(self.lab.known(self.name))
        self.link = StationLink(self.data / "stations" / self.name, lab, self.key, uploads)
        self.link.start()

    def hang_up(self) -> None:
        """End the link."""
        if self.link is not None:
            self.link.end()
            self.link = None

    def end(self) -> None:
        self.hang_up()
        self.station.end()
