"""The coordinator: commands, session, set-up, inference, events; it never processes 30 Hz pictures."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

from runtime.core.errors import PolicyLostError, RuntimeFault
from runtime.core.sentences import Pattern, fixed
from runtime.ipc.estop_requests import reason_of
from runtime.ipc.identity import display_name
from runtime.ipc.messages import (
    Ack,
    Command,
    Event,
    encode,
)
from runtime.ipc.shared_state import EStop
from runtime.processes.coordinator.components import Components
from runtime.processes.coordinator.inbox import Inbox
from runtime.processes.coordinator.queries import QUERIES, Queries
from runtime.processes.coordinator.session.machine import LEASE_COMMANDS
from runtime.processes.coordinator.session.transitions import SessionEvent
from runtime.processes.coordinator.snapshot import build_snapshot
from runtime.station import permissions as rights
from runtime.station.run import Run

log = logging.getLogger(__name__)
_CHANGED = Pattern("session.changed", "{before} -> {after}: {reason}")
_ANSWERED = Pattern("command.answered", "{command} by {who}: {status}")
_ANSWERED_WITH = Pattern("command.answered_with", "{command} by {who}: {status}, {reason}")
_WANTED = Pattern("session.policy_wanted", "{command} by {who}")
_PRESSED = Pattern("session.pressed", "estop by {who}: accepted, {why}")
_ESTOP_FLAG_RAISED = fixed(
    "session.estop_flag_raised",
    "the flag is raised; the guard's own socket says whether control obeys",
)


@dataclass(eq=False)
class Coordinator(Components):
    """Owner of the session and its components; `poll` does everything that is due.

    Lockstep calls `poll` tick by tick. `assembly.assemble` builds a coordinator.
    """

    def __post_init__(self) -> None:
        self.inbox = Inbox(self)
        self.queries = Queries(self.boot, self.events, self.manual, self.preflights)

    @property
    def run(self) -> Run | None:
        """The open run."""
        return self.runs.open

    @property
    def rests(self) -> bool:
        """Whether nothing is in progress and nobody holds the lease, so that only messages need to wake the process."""
        return not (
            self.session.state.meaning.at_work
            or self.setup.active
            or self.runs.open is not None
            or self.runs.is_recording_standalone
            or self.inference.is_pending
            or self.lease.current(self.client_clock.now()) is not None
        )

    def poll(self) -> None:
        """Read messages, check health, advance set-up and inference."""
        self.shared.beat("coordinator", self.clock.now())
        self.inbox.poll()
        for noticed in self.health.poll(self.session.state, self.runs.open):
            self.handle_event(*noticed)
        if missed := self.collecting.poll(self.session.state):
            self.handle_event(*missed)
        for event in (*self.health.poll_recorder(self.session.state), *self.timing.poll(self.clock.now())):
            self.emit(event)
        self.runs.poll()
        self._advance_setup()
        self._advance_inference()
        self.preflights.poll()

    def snapshot(self) -> dict[str, Any]:
        """Return the current snapshot of the station."""
        return build_snapshot(self, self.inbox)

    def end_source_run(self, reason: str) -> None:
        """End the run, because the source of observations, such as a simulator, reported that it is over."""
        self.handle_event(SessionEvent.RUN_ENDED, reason)

    def emit(self, event: Event) -> None:
        self.record_event(event)
        self.runs.record_event(event)

    def record_event(self, event: Event) -> None:
        self.events.append(event)
        log.info("%s: %s", event.kind, event.text)

    def handle_event(self, happening: SessionEvent, reason: str, process: str = "") -> None:
        if happening is SessionEvent.FAMILY_DIED:
            self.emit(Event("family_died", reason, self.clock.now()))
            self.inbox.reset_subscribers()
            self.runs.on_process_restarted(process, reason)
        if happening is SessionEvent.ESTOPPED:
            self.runs.interrupt_standalone_recording(reason)
        if happening in (SessionEvent.FAMILY_DIED, SessionEvent.ESTOPPED):
            self._unlock()
        self.collecting.on_session_event(happening, reason)
        before, run = self.session.state, self.runs.open
        if self.session.handle_event(happening, reason):
            text = _CHANGED(before=before, after=self.session.state, reason=reason)
            state, meaning = str(self.session.state), self.session.state_meaning()
            data = {"state": state, "state_is": meaning, **self._unbegun(run)}
            self.emit(Event("state", text, self.clock.now(), data=data))

    def _unbegun(self, run: Run | None) -> dict[str, Any]:
        """Return data for the event about a `run` that ended before it began; {} for any other run."""
        return {} if run is None or run is self.runs.open else run.never_began_data

    def _unlock(self) -> None:
        """Remove all gripper locks.

        A restarted control has none, and a control under the e-stop may still have them.
        """
        try:
            self.manual.unlock()
        except RuntimeFault as error:
            log.error("grippers may still be locked: %s", error)

    # --- set-up and inference --------------------------------------------------------------------------------

    def _advance_setup(self) -> None:
        if not self.setup.active:
            return
        stage = self.setup.stage
        try:
            complete = self.setup.poll()
        except RuntimeFault as error:
            self.setup.fail()
            self.orders.send_order("hold")
            self.handle_event(SessionEvent.SETUP_FAILED, str(error))
            return
        if self.setup.stage is not stage:
            self.emit(Event("setup", self.setup.stage.sentence, self.clock.now()))
        if complete:
            self.handle_event(SessionEvent.SETUP_DONE, self.setup.outcome)

    def _advance_inference(self) -> None:
        try:
            answer = self.inference.poll()
        except RuntimeFault as error:
            answer = None
            self._answer_fault(error)
        if answer is not None:
            self.runs.record_event(answer)
        for note in self.inference.pending_notes:
            self.emit(note)
        self.inference.pending_notes.clear()

    def _answer_fault(self, error: RuntimeFault) -> None:
        """Respond to a failed policy as the deployment configures: hold, retry for a while, or end the run.

        A leader is never retried.
        """
        faults, lost = self.spec.deployment.faults, isinstance(error, PolicyLostError)
        answer = faults.policy_lost if lost else faults.policy_error
        if self.spec.collecting:  # a leader is not retried: its operator must arm again
            answer = "hold"
        if answer == "slow" and self.inference.should_retry(error):
            return
        self.emit(Event("policy_lost" if lost else "policy_failed", str(error), self.clock.now()))
        self.handle_event(SessionEvent.RUN_FAILED if answer == "stop" else SessionEvent.HELD, str(error))

    # --- commands ------------------------------------------------------------------------------------------

    def handle(self, command: Command) -> Ack:
        """Return the answer to a command or query of a client."""
        if command.kind == "estop":
            return self._press_estop(command)
        if command.kind == "status":
            return Ack(
                command.uuid, "done", boot=self.boot, sequence=self.session.sequence, data=self.snapshot()
            )
        if refusal := self._permission_problem(command):
            return Ack(command.uuid, "refused", refusal, boot=self.boot, sequence=self.session.sequence)
        if command.kind in QUERIES:
            return self.queries.answer(command)
        before, sequence, run = self.session.state, self.session.sequence, self.runs.open
        ack = self.session.handle(command)
        if ack.status == "accepted" and command.kind in ("setup", "run"):
            self.preflights.cancel(_WANTED(command=command.kind, who=display_name(command)))
        # Renewals of a lease are a stream; only its changes and refusals are worth an event.
        lease_renewed = (
            command.kind in LEASE_COMMANDS and ack.status == "accepted" and ack.sequence == sequence
        )
        if not lease_renewed:
            self.collecting.record_activity()
            fields = {"command": command.kind, "who": display_name(command), "status": ack.status}
            text = _ANSWERED_WITH(**fields, reason=ack.reason) if ack.reason else _ANSWERED(**fields)
            data = {"uuid": command.uuid, "from": str(before), "to": str(self.session.state)}
            data |= {"user": command.user, "role": command.role, "holder": command.holder}
            self.emit(Event("command", text, self.clock.now(), data=data | self._unbegun(run)))
        return ack

    def _press_estop(self, command: Command) -> Ack:
        """Set the e-stop flag in any state, for any sender; the guard latches it, at once or when it is restarted."""
        self.shared.rings["presses"].push(encode(command))
        self.shared.set_estop(EStop.LATCHED)
        data = {"uuid": command.uuid, "user": command.user, "role": command.role, "holder": command.holder}
        text = _PRESSED(who=display_name(command), why=reason_of(command))
        self.emit(Event("command", text, self.clock.now(), data=data))
        return Ack(command.uuid, "accepted", _ESTOP_FLAG_RAISED, boot=self.boot, kind=command.kind)

    def _permission_problem(self, command: Command) -> str:
        """Return the reason why the sender may not use these arguments.

        "" if it may, or if the command is a repetition that was answered before.
        """
        if self.session.answered(command) is not None:
            return ""
        try:
            rights.require(command, self.deployment_spec)
        except RuntimeFault as fault:
            return str(fault)
        return ""

    def close(self) -> None:
        """Close preflights, policy and runner."""
        self.preflights.close()
        self.inference.policy.close()
        self.inference.runner.close()
