"""Client of one station, with which the terminal, the headless driver and scripts command it."""

from __future__ import annotations

import os
import socket
import time
import uuid
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import zmq

from runtime.core.errors import RuntimeFault, TransportError
from runtime.ipc.bus import CommandClient, Endpoints, Subscriber
from runtime.ipc.endpoints import account_name
from runtime.ipc.estop_client import send_urgent
from runtime.ipc.estop_requests import sanitize_text
from runtime.ipc.messages import Ack, Command
from runtime.ipc.session_state import complete_state_meaning

RENEW_S = 1.0
_STOPPING = ("stop", "halt")


class Refused(RuntimeFault):
    """Error that the station refused a command; the message is its reason."""


class StationClient:
    """Client that finds the station in its folder, holds a lease on request and sends commands.

    Each command carries the boot id and sequence number of the newest status that this client has received; the station
    refuses a command as stale if its state has changed since.
    """

    def __init__(self, station_dir: Path, holder: str = "") -> None:
        self.holder = holder or f"terminal:{account_name(os.getuid())}@{socket.gethostname()}"
        self._endpoints = Endpoints(station_dir)
        self._context: zmq.Context[Any] = zmq.Context.instance()
        self._commands: CommandClient | None = None
        self._endpoint = ""
        self._epoch = 0
        self._boot = ""
        self._sequence = 0
        self._clock_offset = 0.0
        self._renewed = 0.0

    def status(self, timeout: float = 2.0) -> dict[str, Any]:
        """Return the station's snapshot. Raises: TransportError if the station does not answer."""
        requested_at = time.monotonic()
        data = complete_state_meaning(self._send(Command(str(uuid.uuid4()), "status"), timeout).data)
        self._boot, self._sequence = data["boot"], data["sequence"]
        self._clock_offset = data["clock"] - requested_at
        return data

    def events_since(self, number: int) -> list[dict[str, Any]]:
        """Return the station's events after `number`."""
        ack = self._send(Command(str(uuid.uuid4()), "events_since", {"number": number}), 2.0)
        return list(ack.data["events"])

    def query(self, kind: str, **arguments: Any) -> Ack:
        """Send a query, which changes nothing and needs no lease. Raises: Refused, TransportError."""
        return self.query_with(kind, arguments)

    def query_with(self, kind: str, arguments: Mapping[str, Any]) -> Ack:
        """Send a query as `query` does; `arguments` may have any names, also those of parameters, such as "kind"."""
        return _accepted(self._send(self._send_query(kind, arguments), 2.0))

    def _send_query(self, kind: str, arguments: Mapping[str, Any]) -> Command:
        return Command(str(uuid.uuid4()), kind, arguments, user=self.holder, holder=self.holder)

    def claim(self, epoch: int = 0) -> None:
        """Claim the lease if it is free or already held by this client.

        Raises:
            Refused: Another holder has it; the message names the holder.
            TransportError: The station does not answer.
        """
        ack = self._command("lease_claim", 2.0, epoch=epoch)
        self._epoch = int(ack.data["epoch"])
        self._renewed = time.monotonic()

    def renew(self) -> None:
        """Renew the lease if the last renewal is older than RENEW_S; cheap to call often."""
        if time.monotonic() - self._renewed >= RENEW_S:
            self._command("lease_renew", 2.0, epoch=self._epoch)
            self._renewed = time.monotonic()

    def release(self) -> None:
        """Release the lease of this client before it expires."""
        self._command("lease_give_up", 2.0, epoch=self._epoch)
        self._epoch = 0

    def command(self, kind: str, timeout: float = 2.0, identity: str = "", **arguments: Any) -> Ack:
        """Claim the lease, fetch the status and send one command.

        Args:
            kind: Kind of the command.
            timeout: Longest wait for the answer [s]; the command expires then too.
            identity: Uuid of the command; "" for a new one.
            arguments: Arguments of the command.

        Raises:
            Refused: The station refuses the lease or the command.
            TransportError: There is no answer; the outcome is unknown.
        """
        try:
            self.claim()
        except Refused:
            if (
                kind not in _STOPPING
            ):  # the station stops some runs of others, and refuses with the holder's name
                raise
        self.status()
        return self.send_command(kind, arguments, identity, timeout)

    def send_command(
        self, kind: str, arguments: Mapping[str, Any], identity: str = "", timeout: float = 2.0
    ) -> Ack:
        """Send one command under the lease that was claimed, based on the newest status that was received.

        Raises:
            Refused: The station refuses the command.
            TransportError: There is no answer; the outcome is unknown.
        """
        return self._command(kind, timeout, self._epoch, identity, arguments)

    def estop(self, why: str) -> Ack:
        """Press the software e-stop at the guard, which needs neither a lease nor the coordinator.

        Raises:
            TransportError: The guard does not answer; the message demands the hardware stop.
        """
        try:
            command = self._send_query("estop", {"why": sanitize_text(why)})
            return send_urgent(self._context, self._endpoints, ("guard", "estop"), command, 2.0)
        except TransportError as error:
            raise TransportError(f"USE THE HARDWARE STOP: {error}") from None

    def subscribe(self, *streams: str) -> Subscriber:
        """Subscribe to live streams of the station: state, joints, event. Raises: TransportError."""
        return Subscriber(self._context, self._endpoints.read("coordinator")["state"], *streams)

    def wait(self, reached: Callable[[dict[str, Any]], bool], timeout: float) -> dict[str, Any]:
        """Return the first status that satisfies `reached`; a lease that is held is renewed meanwhile.

        Raises:
            TransportError: The condition is not met within `timeout` [s], or the station does not answer.
        """
        deadline = time.monotonic() + timeout
        while True:
            status = self.status()
            if reached(status):
                return status
            if time.monotonic() > deadline:
                state, reason = status["state"], status["reason"]
                raise TransportError(f"not reached within {timeout:g} s; the station is {state}: {reason}")
            if self._epoch:
                self.renew()
            time.sleep(0.02)

    def _command(
        self,
        kind: str,
        timeout: float,
        epoch: int = 0,
        identity: str = "",
        arguments: Mapping[str, Any] | None = None,
    ) -> Ack:
        command = Command(
            identity or str(uuid.uuid4()),
            kind,
            arguments or {},
            user=self.holder,
            holder=self.holder,
            epoch=epoch,
            boot=self._boot,
            sequence=self._sequence,
            valid_until=time.monotonic() + self._clock_offset + timeout,
        )
        ack = self._send(command, timeout)
        self._sequence = max(self._sequence, ack.sequence)
        return _accepted(ack)

    def _send(self, command: Command, timeout: float) -> Ack:
        endpoint = self._endpoints.read("coordinator")["commands"]
        if self._commands is None or endpoint != self._endpoint:
            self.close()
            owner = self._endpoints.owner
            self._commands, self._endpoint = CommandClient(self._context, endpoint, owner=owner), endpoint
        return self._commands.request(command, timeout)

    def close(self) -> None:
        """Close the connection; the next request opens another."""
        if self._commands is not None:
            self._commands.close()
            self._commands = None


def _accepted(ack: Ack) -> Ack:
    if ack.status in ("refused", "failed"):
        raise Refused(ack.reason)
    return ack
