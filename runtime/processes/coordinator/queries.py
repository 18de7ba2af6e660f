"""Queries of clients: nothing moves, and no lease is needed."""

from __future__ import annotations

from runtime.core.errors import RuntimeFault
from runtime.core.sentences import Pattern
from runtime.ipc.bus import EventLog
from runtime.ipc.messages import Ack, Command
from runtime.processes.coordinator.manual.manual_control import ManualControl
from runtime.processes.coordinator.preflight_service import PREFLIGHT_QUERIES, PreflightService

_EVENTS_SINCE_NUMBER = Pattern(
    "queries.events_since_number",
    "events_since number = {given!r}: must be a whole number",
)

QUERIES = ("events_since", "aim", *PREFLIGHT_QUERIES)


class Queries:
    """Answers to QUERIES, for every client with access."""

    def __init__(
        self, boot: str, events: EventLog, manual: ManualControl, preflights: PreflightService
    ) -> None:
        self._boot, self._events, self._manual, self._preflights = boot, events, manual, preflights

    def answer(self, command: Command) -> Ack:
        """Return the answer to one of QUERIES."""
        if command.kind == "events_since":
            return self._events_since(command)
        if command.kind == "aim":
            return self._aim(command)
        return self._preflights.handle(command, self._boot)

    def is_loading(self, command: Command) -> bool:
        """Return True if the answer needs kinematics that are still loading; the caller must ask again later."""
        return command.kind == "aim" and self._manual.is_loading(command.args)

    def _events_since(self, command: Command) -> Ack:
        number = command.args.get("number", 0)
        if not isinstance(number, int):
            return Ack(command.uuid, "refused", _EVENTS_SINCE_NUMBER(given=number))
        return Ack(command.uuid, "done", boot=self._boot, data={"events": self._events.since(number)})

    def _aim(self, command: Command) -> Ack:
        """Return a preview of a target."""
        try:
            return Ack(command.uuid, "done", boot=self._boot, data=self._manual.aim(command.args))
        except RuntimeFault as error:
            return Ack(command.uuid, "refused", str(error))
