"""Service for preflights of a station: start, report, and the server of its policy.

Nothing moves, and no lease is needed; a run or a set-up is never disturbed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from runtime.config.loader import apply_changes, server_address
from runtime.core.clock import Clock
from runtime.core.errors import RuntimeFault
from runtime.core.plugins import variants
from runtime.core.sentences import Pattern
from runtime.ipc.command_arguments import PolicyServerRequest, PreflightReportRequest, PreflightRequest, read
from runtime.ipc.identity import display_name
from runtime.ipc.messages import Ack, Command, Event
from runtime.ipc.session_state import SessionState
from runtime.station.preflight_child import Preflights
from runtime.station.spec import StationSpec

_ENDED = Pattern("preflight.ended", "preflight of {about}: {verdict}")
_BEGUN = Pattern("preflight.begun", "preflight of {about} by {who}")
_AT_WORK = Pattern(
    "preflight.at_work",
    "preflight is not allowed while {state}: the station's machine and policy are at work; allowed "
    "while {allowed}",
)
_SERVER_IN_USE = Pattern(
    "preflight.server_in_use",
    "preflight: the station is ready to run with this server, and a server of policy.kind = {kind!r} "
    "has one client's checkpoint at a time: set up with the checkpoint instead",
)

PREFLIGHT_QUERIES = ("preflight", "preflight_report", "policy_server")


class PreflightService:
    """Preflights of the coordinator.

    `in_force` returns the specification of the last set-up. `own` is the specification of the deployment, which
    preflights check.
    """

    def __init__(
        self,
        in_force: Callable[[], StationSpec],
        own: StationSpec,
        state: Callable[[], SessionState],
        say: Callable[[Event], None],
        clock: Clock,
        preflights: Preflights | None = None,
    ) -> None:
        self._in_force, self._own = in_force, own
        self._state, self._say, self._clock = state, say, clock
        self._preflights = preflights or Preflights()

    def handle(self, command: Command, boot: str) -> Ack:
        """Return the answer to one of PREFLIGHT_QUERIES."""
        answer = {
            "preflight": self._start,
            "preflight_report": self._report,
            "policy_server": self._server,
        }[command.kind]
        try:
            return Ack(command.uuid, "done", boot=boot, data=answer(command))
        except RuntimeFault as fault:
            return Ack(command.uuid, "refused", str(fault), boot=boot)

    def poll(self) -> None:
        """Emit an event if a preflight has ended."""
        ended = self._preflights.poll()
        if ended is not None:
            verdict = ended.finished.get("verdict") or ended.failure
            self._emit(_ENDED(about=ended.about, verdict=verdict), {"id": ended.id})

    def cancel(self, why: str) -> None:
        """Cancel a preflight, because the policy's server is needed for a run."""
        self._preflights.cancel(why)

    def close(self) -> None:
        """End a running preflight."""
        self._preflights.close()

    def _start(self, command: Command) -> dict[str, Any]:
        request = read("preflight", PreflightRequest, command.args)
        self._require_free(request)
        longest = self._preflights.start(request, self._own.resolved)
        self._emit(_BEGUN(about=request.about, who=display_name(command)), {"id": request.id})
        return {"id": request.id, "longest_s": longest}

    def _require_free(self, request: PreflightRequest) -> None:
        """Raise RuntimeFault if the preflight would disturb the station.

        That is so if the station is at work. It is also so if the station is ready, the preflight would use its policy
        server, and this server keeps the state of only one client.
        """
        state = self._state()
        if state.meaning.at_work:
            raise RuntimeFault(
                _AT_WORK(
                    state=state,
                    allowed=", ".join(
                        free_state for free_state in SessionState if not free_state.meaning.at_work
                    ),
                )
            )
        if not state.meaning.ready:
            return
        settings = apply_changes(self._own.resolved, request.changes, "preflight").deployment
        exclusive = getattr(variants("runtime.policies")[settings.policy.kind], "EXCLUSIVE", False)
        if exclusive and server_address(settings) == server_address(self._in_force().deployment):
            raise RuntimeFault(_SERVER_IN_USE(kind=settings.policy.kind))

    def _report(self, command: Command) -> dict[str, Any]:
        return self._preflights.report(read("preflight_report", PreflightReportRequest, command.args).id)

    def _server(self, command: Command) -> dict[str, Any]:
        """Return the data of the answer to a query for a policy server: its address, and the state of the session.

        If the query has a `policy`, the server is the one of that policy. Otherwise it is the server of the policy in
        force.
        """
        request = read("policy_server", PolicyServerRequest, command.args)
        settings = self._in_force().deployment
        if request.policy is not None:
            settings = apply_changes(
                self._own.resolved, {"policy": request.policy}, "policy_server"
            ).deployment
        return {
            "server": server_address(settings),
            "state": str(self._state()),
            "state_is": self._state().meaning_dict(),
        }

    def _emit(self, text: str, data: dict[str, Any]) -> None:
        self._say(Event("preflight", text, self._clock.now(), data=data))
