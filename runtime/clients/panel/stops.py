"""Actions of the panel: press the e-stop and stop a run. It can neither move the robot nor release the e-stop."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zmq

from runtime.core.errors import CodecError, TransportError
from runtime.ipc.bus import Endpoints
from runtime.ipc.estop_client import send_urgent
from runtime.ipc.estop_requests import sanitize_text
from runtime.ipc.identity import PANEL
from runtime.ipc.messages import Ack, Command

_GUARD_S, _COORDINATOR_S = 1.0, 1.0


@dataclass(frozen=True, slots=True)
class StopResult:
    """Result of an action: whether the station has carried it out, and the text for the page."""

    done: bool
    text: str


class Stops:
    """Sender of stops for one station's panel; thread-safe, because each stop uses a connection of its own."""

    def __init__(self, context: zmq.Context[Any], station_dir: Path) -> None:
        self._context, self._endpoints = context, Endpoints(station_dir)

    def press(self, source: str, uuid: str) -> StopResult:
        """Press the e-stop at the guard; if it does not answer, at the coordinator, which can set the latch too."""
        command = self._command(
            uuid, "estop", source, {"why": sanitize_text(f"at the station's panel, from {source}")}
        )
        try:
            ack = self._ask(command, ("guard", "estop"), _GUARD_S)
        except (TransportError, CodecError):
            try:
                ack = self._ask(command, ("coordinator", "commands"), _COORDINATOR_S)
            except (TransportError, CodecError) as fault:
                return StopResult(False, f"USE THE HARDWARE STOP: {fault}")
        if ack.status in ("done", "accepted"):
            return StopResult(True, ack.reason)
        text = ack.reason if "HARDWARE STOP" in ack.reason else f"USE THE HARDWARE STOP: {ack.reason}"
        return StopResult(False, text)

    def stop(self, source: str, uuid: str) -> StopResult:
        """Stop the run, regardless of the lease."""
        command = self._command(uuid, "stop", source, {})
        try:
            ack = self._ask(command, ("coordinator", "commands"), _COORDINATOR_S)
        except (TransportError, CodecError) as fault:
            return StopResult(False, f"{fault}; the E-STOP goes another way")
        accepted = ack.status in ("done", "accepted")
        return StopResult(accepted, "stopped" if accepted else ack.reason)

    def _command(self, uuid: str, kind: str, source: str, args: dict[str, Any]) -> Command:
        holder = PANEL + source
        return Command(uuid, kind, args, user=holder, holder=holder)

    def _ask(self, command: Command, where: tuple[str, str], seconds: float) -> Ack:
        return send_urgent(self._context, self._endpoints, where, command, seconds)
