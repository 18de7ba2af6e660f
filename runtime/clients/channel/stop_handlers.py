"""Handlers of stops, which are never queued behind other messages.

`stop` and `halt` go to the coordinator, the e-stop to the guard.
"""

from __future__ import annotations

import uuid
from collections.abc import Callable
from typing import Any

from runtime.clients.channel import json_answers
from runtime.clients.channel.message import Message
from runtime.clients.channel.outcomes import Outcome, Outcomes
from runtime.clients.channel.scripts import ScriptActivity
from runtime.clients.channel.verbs import stops
from runtime.clients.client import Refused, StationClient
from runtime.core.errors import RuntimeFault, TransportError

_ANYBODY = 'anybody may {"command": "estop"}'


def is_stop(message: Message) -> bool:
    """Return True if the message is a stop that needs a lease."""
    if message.form == "command":
        return message.name in ("stop", "halt")
    return message.form == "cmd" and stops(message.name, message.argument)


def is_estop(message: Message) -> bool:
    """Return True if the message presses the e-stop, which needs no lease."""
    return message.form != "query" and message.name == "estop"


class StopHandler:
    """Handler of stops, which go to the coordinator.

    A stop is sent under the lease of whichever script of this channel holds it.
    """

    def __init__(
        self, open_client: Callable[[str], StationClient], lives: ScriptActivity, outcomes: Outcomes
    ) -> None:
        self._open, self._lives, self._outcomes = open_client, lives, outcomes

    def answer(self, holder: str, message: Message) -> dict[str, Any]:
        """Execute `stop` or `halt` and return the answer; further fields of the message are ignored."""
        kind = "halt" if message.name == "halt" else "stop"
        outcome = Outcome(message.id or str(uuid.uuid4()), message.name, kind, "done")
        state = None
        try:
            state = self._stop(holder, kind)
        except TransportError as fault:
            outcome.resolve("unknown", f"{fault}; {_ANYBODY}")
        except Refused as refusal:
            outcome.resolve("refused", f"{refusal}; {_ANYBODY}")
        self._outcomes.add(outcome)
        return json_answers.command_answer(message, outcome, {}, state)

    def _stop(self, holder: str, kind: str) -> str:
        """Send the stop and return the station's state after it.

        If another script of the channel holds the lease, the stop is sent in its name, otherwise in that of the sender.
        """
        client = self._open(holder)
        try:
            lease_holder = client.status()["lease"]["holder"]
            if lease_holder != holder and self._lives.is_known(lease_holder):
                client.close()
                client = self._open(lease_holder)
            client.claim()
            client.status()
            client.send_command(kind, {})
            return str(client.status()["state"])
        finally:
            client.close()

    def close(self) -> None:
        """Do nothing: no connection stays open."""


class EStopHandler:
    """Handler of e-stop presses, which go to the guard."""

    def __init__(self, open_client: Callable[[str], StationClient], outcomes: Outcomes) -> None:
        self._open, self._outcomes = open_client, outcomes

    def answer(self, holder: str, message: Message) -> dict[str, Any]:
        """Press the e-stop and return the guard's answer; a press is never refused for an argument."""
        outcome = Outcome(message.id or str(uuid.uuid4()), message.name, "estop", "done")
        client = self._open(holder)
        try:
            ack = client.estop(str(message.arguments["why"]))
            outcome.resolve("done" if ack.status == "done" else "failed", ack.reason)
        except RuntimeFault as fault:
            outcome.resolve("unknown", str(fault))
        finally:
            client.close()
        self._outcomes.add(outcome)
        return json_answers.command_answer(message, outcome, {}, None)

    def close(self) -> None:
        """Do nothing: no connection stays open."""
