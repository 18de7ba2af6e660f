"""State machine of a station: answers to commands and events, from the table of transitions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from runtime.core.errors import RuntimeFault
from runtime.core.sentences import Pattern, fixed
from runtime.ipc.command_arguments import ARGUMENTS, read
from runtime.ipc.identity import PROGRAMS, at_the_panel, display_name
from runtime.ipc.messages import Ack, AckStatus, Command
from runtime.ipc.session_state import SessionState
from runtime.processes.coordinator.lease import Lease
from runtime.processes.coordinator.session.transitions import (
    CANCEL,
    CANCELLED,
    CANCELLING,
    COMMANDS,
    EVENT_TRANSITIONS,
    MOVED_BY_HAND,
    REASONS,
    STOPPING,
    SessionEvent,
    TransitionResult,
)

if TYPE_CHECKING:
    from runtime.processes.coordinator.operations import SessionActions

_WAITING_FOR_OBSERVATION = fixed("session.waiting_for_observation", "waiting for the first observation")
_NO_UUID = fixed("session.no_uuid", "a command needs a uuid of its own")
_UUID_OF_ANOTHER = Pattern("session.uuid_of_another", "its uuid was given to the command {kind!r} before")
_UNKNOWN_COMMAND = Pattern("session.unknown_command", "unknown command {kind!r}; known: {known}")
_STALE_BOOT = fixed("session.stale_boot", "stale: it was decided before the runtime was restarted")
_STALE_STATE = Pattern(
    "session.stale_state",
    "stale: the state has changed since it was decided (now {state}: {reason})",
)
_STALE_DEADLINE = fixed("session.stale_deadline", "stale: it arrived after its deadline")
_NOT_ALLOWED = Pattern(
    "session.not_allowed",
    "{command} is not allowed while {state} ({reason}); allowed: {allowed}",
)
_NOT_ALLOWED_NOW = Pattern(
    "session.not_allowed_now",
    "{command} is not allowed now: {why}; allowed: {allowed}",
)
_ESTOP_ELSEWHERE = fixed(
    "session.estop_elsewhere",
    "the e-stop has a socket of its own: send it to the guard",
)
_HOLDER_HIDDEN = fixed(
    "session.holder_hidden",
    "the page of the lease's holder is hidden while the robot moves",
)

LEASE_COMMANDS = ("lease_claim", "lease_renew", "lease_give_up")
ANSWERS_KEPT = 5000
_OF_THE_LINK = (SessionEvent.CONNECTED, SessionEvent.INCOMPLETE, SessionEvent.LINK_LOST)


class SessionMachine:
    """State machine of the session, whose state only `handle` and `handle_event` change."""

    def __init__(self, effects: SessionActions, lease: Lease, boot: str, now: Callable[[], float]) -> None:
        self._effects = effects
        self._lease = lease
        self._boot = boot
        self._now = now
        self.state = SessionState.DISCONNECTED
        self.reason: str = _WAITING_FOR_OBSERVATION
        self.sequence = 0
        self._connected = False  # whether complete observations arrive
        self._unattended = False  # a run continues although its lease holder is lost
        self._answers: dict[str, Ack] = {}

    def restore_answers(self, answers: dict[str, Ack]) -> None:
        """Restore answers from before a restart: a repeated uuid gets its first answer, and no epoch is reused."""
        self._answers = answers | self._answers
        epochs = [ack.data.get("epoch") for ack in answers.values()]
        self._lease.raise_epoch_floor(max((e for e in epochs if isinstance(e, int)), default=0))

    def status(self) -> dict[str, Any]:
        """Return state, reason, and the allowed commands."""
        return {
            "sequence": self.sequence,
            "state": str(self.state),
            "state_is": self.state_meaning(),
            "reason": self.reason,
            "allowed": self.allowed(),
            "guarded": self.blocked_commands(),
        }

    def allowed(self) -> list[str]:
        """Return the commands that would be accepted now."""
        situation = self._effects.situation
        commands = [
            kind
            for kind, rule in COMMANDS.items()
            if self.state in rule.allowed and not rule.guard(self.state, situation)
        ]
        if self.state is SessionState.SETTING_UP:
            commands.extend(CANCELLING)
        return [*commands, "estop"]

    def blocked_commands(self) -> dict[str, str]:
        """Return the commands of this state that would be refused now, with the reasons."""
        situation = self._effects.situation
        reasons = {
            kind: rule.guard(self.state, situation)
            for kind, rule in COMMANDS.items()
            if self.state in rule.allowed
        }
        return {kind: reason for kind, reason in reasons.items() if reason}

    def handle(self, command: Command) -> Ack:
        """Execute `command` and return the answer; if its uuid was answered before, return that answer again.

        If the earlier command with this uuid was of another kind, the new command is no repetition: a stop is executed
        all the same, any other command is refused.
        """
        if not command.uuid:  # all such commands would be repetitions of each other
            return self._ack(command, "refused", _NO_UUID)
        if (repeated := self.answered(command)) is not None:
            return repeated
        first = self._answers.get(command.uuid)
        if first is not None and command.kind not in STOPPING:
            return self._ack(command, "refused", _UUID_OF_ANOTHER(kind=first.kind))
        refusal, result = self._refusal(command), None
        if not refusal:
            try:
                result = self._carry_out(command)
            except RuntimeFault as error:
                refusal = str(error)
        ack = self._ack(command, "refused" if refusal else "accepted", refusal, result)
        if command.kind != "lease_renew":  # a stream, not a discrete command: there is nothing to repeat
            self._answers.setdefault(command.uuid, ack)
            if len(self._answers) > ANSWERS_KEPT:
                del self._answers[next(iter(self._answers))]
        return ack

    def answered(self, command: Command) -> Ack | None:
        """Return the first answer if the command is a repetition (same uuid and kind), else None."""
        first = self._answers.get(command.uuid)
        return first if first is not None and first.kind in ("", command.kind) else None

    def state_meaning(self) -> dict[str, Any]:
        """Return the meaning of the state for a snapshot.

        While observations are missing, the state does not count as connected.
        """
        row = self.state.meaning
        return replace(row, connected=row.connected and self._connected).to_dict()

    def handle_event(self, happening: SessionEvent, reason: str = "") -> bool:
        """Apply an event; return True if the state changed.

        Raises:
            RuntimeFault: An action that the event requires, such as holding the robot, failed. The state is then
            unchanged.
        """
        if happening in _OF_THE_LINK:
            self._connected = happening is SessionEvent.CONNECTED
        after = EVENT_TRANSITIONS.get((happening, self.state))
        if happening is SessionEvent.LEASE_ENDED and self.state in MOVED_BY_HAND:
            self._effects.hold(reason)
        if after is None or (after is self.state and reason == self.reason):
            return False
        before = self.state
        if happening in (SessionEvent.HELD, SessionEvent.LEASE_ENDED, SessionEvent.LINK_LOST):
            self._stop_for(before, reason)
        elif happening in (SessionEvent.ESTOPPED, SessionEvent.FAMILY_DIED):
            self._interrupt(before, reason)
        elif happening is SessionEvent.RUN_ENDED:
            self._effects.end_run("finished", reason)
        elif happening is SessionEvent.RUN_FAILED:
            self._effects.end_run("failed", reason)
        self._enter(after, reason)
        self._unattended = happening is SessionEvent.HOLDER_LOST
        return True

    def _stop_for(self, before: SessionState, reason: str) -> None:
        if before is SessionState.SETTING_UP:
            self._effects.cancel_setup(reason)
        self._effects.hold(reason)

    def _interrupt(self, before: SessionState, reason: str) -> None:
        if before is SessionState.SETTING_UP:
            self._effects.cancel_setup(reason)
        self._effects.end_run("interrupted", reason)

    def _refusal(self, command: Command) -> str:
        if command.kind in LEASE_COMMANDS:
            return ""
        if command.kind not in COMMANDS and command.kind != "estop":
            return _UNKNOWN_COMMAND(kind=command.kind, known=", ".join([*COMMANDS, "estop", *LEASE_COMMANDS]))
        if command.kind not in STOPPING:
            stale = self._staleness(command)
            if stale:
                return stale
        if command.kind != "estop":
            refusal = self._lease.check(command.holder, command.epoch, self._now())
            if refusal and not self._stops_without(command):
                return refusal
        return self._not_now(command.kind)

    def _stops_without(self, command: Command) -> bool:
        """Return True if the command is a stop that needs no lease.

        That is so if it comes from the station's panel, if the run is unattended, or if another program drives.
        """
        if command.kind not in STOPPING:
            return False
        lease = self._lease.current(self._now())
        is_driven = lease is not None and lease.holder.startswith(PROGRAMS)
        return self._unattended or is_driven or at_the_panel(command)

    def _staleness(self, command: Command) -> str:
        if command.boot != self._boot:
            return _STALE_BOOT
        if command.sequence < self.sequence:
            return _STALE_STATE(state=self.state, reason=self.reason)
        if not self._now() <= command.valid_until:  # NaN included
            return _STALE_DEADLINE
        return ""

    def _not_now(self, kind: str) -> str:
        allowed = self.allowed()
        if kind in allowed:
            return ""
        possible = ", ".join(allowed)
        if self.state in COMMANDS[kind].allowed:
            reason = COMMANDS[kind].guard(self.state, self._effects.situation)
            return _NOT_ALLOWED_NOW(command=kind, why=reason, allowed=possible)
        return _NOT_ALLOWED(command=kind, state=self.state, reason=self.reason, allowed=possible)

    def _carry_out(self, command: Command) -> TransitionResult | None:
        """Execute a command.

        Raises:
            RuntimeFault: its arguments are invalid, or its effect refuses.
        """
        if command.kind in LEASE_COMMANDS:
            self._lease_command(command)
            return None
        if command.kind == "estop":
            raise RuntimeFault(_ESTOP_ELSEWHERE)
        rule = COMMANDS[command.kind]
        if self.state is SessionState.SETTING_UP and command.kind in CANCELLING:
            rule = CANCEL
        takes = ARGUMENTS[command.kind]
        request = read(command.kind, takes, command.args) if takes else None
        self._effects.set_requester(command.user or command.holder, command.uuid)
        result = rule.effect(self._effects, request)
        after = rule.next(self.state, request)
        if after:
            reason = CANCELLED if rule is CANCEL else REASONS.get(command.kind, "")
            self._enter(after, reason)
        return result

    def _lease_command(self, command: Command) -> None:
        now = self._now()
        before = self._lease.current(now)
        act = {
            "lease_claim": self._lease.claim,
            "lease_renew": self._lease.renew,
            "lease_give_up": self._lease.release,
        }[command.kind]
        if command.kind == "lease_renew" and command.args.get("hidden") is True and self.state.meaning.moving:
            self._lease.hide(command.holder, command.epoch, now)
            raise RuntimeFault(_HOLDER_HIDDEN)
        refusal = act(command.holder, command.epoch, now, display_name(command))
        after = self._lease.current(now)
        if (before and before.epoch) != (after and after.epoch):
            self.sequence += 1
            if after and self._unattended:
                self._unattended, self.reason = False, ""
        if refusal:
            raise RuntimeFault(refusal)

    def _enter(self, state: SessionState, reason: str) -> None:
        self.state, self.reason, self._unattended = state, reason, False
        self.sequence += 1

    def _ack(
        self, command: Command, status: AckStatus, reason: str, result: TransitionResult | None = None
    ) -> Ack:
        holder = self._lease.current(self._now())
        lease = {"epoch": holder.epoch, "holder": holder.holder} if holder else {}
        data = {**(result or {}), **lease}
        return Ack(
            command.uuid, status, reason, self.allowed(), self._boot, self.sequence, data, command.kind
        )
