"""Connection of this process to a station's runtime: requests with a deadline, from any thread.

Rights are decided in `leases` and `commands`. Nothing here uses the database, so that stopping works without it.
"""

from __future__ import annotations

import re
import threading
import time
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache
from typing import Any
from uuid import uuid4

import zmq
from django.conf import settings
from django.utils.timezone import localtime

from evaweb.core.binary_frames import to_json_value
from evaweb.core.errors import NotFound, StationGone
from evaweb.stations.models import STATION_NAME
from runtime.core.sentences import Pattern, checked_row
from runtime.ipc.bus import CodecError, CommandClient, Endpoints, Key, TransportError
from runtime.ipc.estop_client import NoAnswer as Unanswered
from runtime.ipc.estop_client import NotSent, send_urgent
from runtime.ipc.messages import Ack, Command
from runtime.ipc.session_state import complete_state_meaning

_LATE = Pattern("stations.runtime_client.late", "{name} has not answered {kind} in time")
_OUTCOME_UNKNOWN = Pattern(
    "stations.runtime_client.outcome_unknown",
    "{name} has not answered {kind} in time: outcome unknown, look at the robot",
)
_SILENT_BECAUSE = Pattern("stations.runtime_client.late_because", "{what}{why}")
_SAYS = Pattern("stations.runtime_client.says", "{name}: {why}")
_NO_NAME = Pattern(
    "stations.runtime_client.no_name",
    "station {name!r:.80}: letters, digits, '.', '_' and '-' make a name",
)
_NOT_SENT = Pattern(
    "stations.runtime_client.not_sent",
    "{name} does not answer: {kind} was not sent",
)
_LINK = Pattern("stations.runtime_client.link", "{name}, since {since}: {why}")
_NOT_RUNNING = Pattern(
    "stations.runtime_client.not_running",
    "{name} is not running: its runtime has to be started",
)
_UNREADABLE = Pattern(
    "stations.runtime_client.unreadable",
    "{name} answered {kind} with what cannot be read: {error}",
)

_CLOCK_KNOWN_S = 60.0  # validity of a measured clock offset


class NoAnswer(StationGone):
    """Error if a request may have arrived and may have been carried out: its outcome is unknown."""

    status = 504


class StationConnection:
    """Connection to one station; reconnects when its runtime has restarted."""

    def __init__(self, name: str) -> None:
        if not re.fullmatch(STATION_NAME, name):
            raise NotFound(_NO_NAME(name=name))
        self.name = name
        folder = settings.DATA_DIR / "stations" / name
        self.endpoints = Endpoints(folder)
        self._key = Key(folder)  # signs commands sent in a user's name
        self._lock = threading.Lock()
        self._client: CommandClient | None = None
        self._endpoint = ""
        self._ahead = 0.0  # its clock minus this process's [s]
        self._ahead_known = -float("inf")

    def request(self, command: Command, *, timeout: float | None = None, expires: bool = False) -> Ack:
        """Return the coordinator's answer; one request at a time over a persistent connection.

        With `expires` the command becomes void when this call gives up: it is never carried out after its user has been
        informed that it was lost.

        Raises:
            StationGone: The command was not sent.
            NoAnswer: The outcome is unknown.
        """
        deadline = time.monotonic() + (timeout or settings.EVA_COMMAND_TIMEOUT_S)
        if not self._lock.acquire(timeout=max(0.0, deadline - time.monotonic())):
            raise StationGone(_NOT_SENT(name=self.name, kind=command.kind))
        try:
            client = self._connected()
            if expires:
                self._learn_clock(client, command.kind, deadline)
                command = replace(command, valid_until=deadline + self._ahead)
            return self._request(client, command, deadline)
        finally:
            self._lock.release()

    def request_urgent(self, command: Command, process: str, key: str, timeout: float) -> Ack:
        """Return the answer over a new connection, so that no hanging request delays it.

        `process` and `key` name the socket: the coordinator's "commands", the guard's "estop".
        """
        try:
            context = zmq.Context.instance()
            return send_urgent(context, self.endpoints, (process, key), command, timeout, self._key)
        except CodecError as error:
            raise self._unreadable(command, error) from error
        except Unanswered as error:
            raise NoAnswer(_SILENT_BECAUSE(what=self._silence(command), why=error.why)) from None
        except NotSent as error:
            raise StationGone(_SAYS(name=self.name, why=error)) from None
        except TransportError:
            raise self._not_running() from None

    def status(self, timeout: float | None = None) -> dict[str, Any]:
        """Return the newest snapshot as JSON-compatible objects. Raises: StationGone."""
        return complete_state_meaning(
            to_json_value(self.request(Command(str(uuid4()), "status"), timeout=timeout).data)
        )

    def events_since(self, number: int, timeout: float | None = None) -> tuple[str, list[dict[str, Any]]]:
        """Return the runtime's boot id and its events after `number`, JSON-compatible. Raises: StationGone."""
        ack = self.request(Command(str(uuid4()), "events_since", {"number": number}), timeout=timeout)
        return ack.boot, [checked_row(row) for row in to_json_value(ack.data.get("events", []))]

    def address(self, process: str, key: str) -> str:
        """Return the address of a socket, as its process last wrote it. Raises: StationGone if there is none."""
        if address := self.endpoints.address(process, key):
            return address
        raise self._not_running()

    def _not_running(self) -> StationGone:
        return StationGone(self._link() or _NOT_RUNNING(name=self.name))

    def _link(self) -> str:
        """Return the gate's report on the link to a station on another computer, "" if there is none."""
        try:
            since = localtime(datetime.fromtimestamp(float(self.endpoints.address("link", "since")), UTC))
        except (ValueError, OverflowError, OSError):
            return ""
        return _LINK(name=self.name, since=f"{since:%H:%M:%S}", why=self.endpoints.address("link", "why"))

    def _connected(self) -> CommandClient:
        endpoint = self.address("coordinator", "commands")
        if self._client is None or endpoint != self._endpoint:
            if self._client is not None:
                self._client.close()
            owner = self.endpoints.owner
            self._client = CommandClient(zmq.Context.instance(), endpoint, self._key, owner)
            self._endpoint = endpoint
            self._ahead_known = -float("inf")
        return self._client

    def _learn_clock(self, client: CommandClient, kind: str, deadline: float) -> None:
        if time.monotonic() - self._ahead_known < _CLOCK_KNOWN_S:
            return
        try:
            ack = self._request(client, Command(str(uuid4()), "status"), deadline)
            clock = float(ack.data["clock"])
        except (NoAnswer, KeyError):
            raise StationGone(_NOT_SENT(name=self.name, kind=kind)) from None
        self._ahead_known = time.monotonic()
        self._ahead = clock - self._ahead_known

    def _request(self, client: CommandClient, command: Command, deadline: float) -> Ack:
        try:
            return client.request(command, max(0.0, deadline - time.monotonic()))
        except TransportError:
            raise self._silent(command) from None
        except CodecError as error:
            raise self._unreadable(command, error) from error

    def _silent(self, command: Command) -> NoAnswer:
        return NoAnswer(self._silence(command))

    def _silence(self, command: Command) -> str:
        late = _LATE if command.kind == "status" else _OUTCOME_UNKNOWN
        return late(name=self.name, kind=command.kind)

    def _unreadable(self, command: Command, error: CodecError) -> NoAnswer:
        return NoAnswer(_UNREADABLE(name=self.name, kind=command.kind, error=error))


def connection_to(name: str) -> StationConnection:
    """Return this process's connection to the station. Raises: NotFound for an invalid name.

    Only connections to existing stations are cached, so that requests for invented names do not accumulate.
    """
    wire = StationConnection(name)
    return _kept(name) if (settings.DATA_DIR / "stations" / name).is_dir() else wire


@cache
def _kept(name: str) -> StationConnection:
    return StationConnection(name)
