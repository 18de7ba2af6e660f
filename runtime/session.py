"""The one state machine of a station: which command is allowed when, and what follows from what happens."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from runtime.errors import RuntimeFault
from runtime.lease import Lease
from runtime.messages import Ack, AckStatus, Command, Mode
from runtime.requests import (
    GripperRequest,
    MoveRequest,
    Nothing,
    RunRequest,
    SetUpRequest,
    TuneRequest,
    read,
)
from runtime.section import Section


class State(StrEnum):
    """The session's state; one word each, the same everywhere."""

    DISCONNECTED = "disconnected"
    IDLE = "idle"
    SETTING_UP = "setting_up"
    READY = "ready"
    RUNNING = "running"
    HOLDING = "holding"
    FAULTED = "faulted"


class Happening(StrEnum):
    """What the session is told of by the rest of the runtime."""

    CONNECTED = "connected"  # a complete observation arrived
    INCOMPLETE = "incomplete"  # observations arrive, but not from every camera
    DISPLACED = "displaced"  # the arm is not where it was told to hold
    LINK_LOST = "link_lost"  # observations have been missing for long
    SETUP_DONE = "setup_done"
    SETUP_FAILED = "setup_failed"
    HELD = "held"  # control holds, for a reason of its own
    RUN_ENDED = "run_ended"  # the run is over by itself: its time, its source
    RUN_FAILED = "run_failed"  # it could not begin
    LEASE_ENDED = "lease_ended"
    ESTOPPED = "estopped"
    RELEASED = "released"
    FAMILY_DIED = "family_died"  # a process of the family was restarted


Told = Mapping[str, Any]  # for the data of an answer


@dataclass(frozen=True, slots=True)
class Situation:
    """What the guards of commands look at, beside the state."""

    mode: Mode | None = None  # of the open run
    trial: bool = False  # the open run is one of a trial: nobody may change what is measured
    proposed: bool = False  # a chunk is shown and waits to be committed
    asked: bool = False  # the policy is being asked, or its answer has not reached control
    executing: bool = False  # steps are planned
    first_action: bool = False  # the last set-up knows the policy's first action


class Effects(ABC):
    """What the session makes happen; implemented by main, recorded by tests.

    Each raises RuntimeFault to refuse, and has changed nothing then. What is returned goes into the answer.
    """

    @property
    @abstractmethod
    def situation(self) -> Situation: ...

    @abstractmethod
    def begin_setup(self, asked: SetUpRequest) -> Told: ...

    @abstractmethod
    def cancel_setup(self, reason: str) -> None: ...

    @abstractmethod
    def begin_run(self, asked: RunRequest) -> Told: ...

    @abstractmethod
    def hold(self, reason: str) -> None:
        """Decelerate, hold, stop asking the policy; a run stays open."""

    @abstractmethod
    def resume_run(self) -> None: ...

    @abstractmethod
    def end_run(self, status: str, reason: str) -> None:
        """Decelerate, hold, close the run and its episode; nothing to do where no run is open."""

    @abstractmethod
    def go_home(self) -> None: ...

    @abstractmethod
    def release_estop(self) -> None: ...

    @abstractmethod
    def start_recording(self) -> Told: ...

    @abstractmethod
    def stop_recording(self) -> None: ...

    @abstractmethod
    def tune(self, asked: TuneRequest) -> Told:
        """Another strategy, other parameters, another instruction from now on."""

    @abstractmethod
    def step(self) -> None:
        """Ask for one chunk: to be executed in the mode step, to be shown in preview."""

    @abstractmethod
    def commit(self) -> None:
        """Execute the chunk that is shown."""

    @abstractmethod
    def cancel(self) -> None:
        """Forget the chunk that is shown, leave the rest of the one that is executed, end a motion; hold."""

    @abstractmethod
    def move(self, asked: MoveRequest) -> Told: ...

    @abstractmethod
    def grip(self, asked: GripperRequest) -> Told: ...

    @abstractmethod
    def approach(self) -> None:
        """Go to the policy's first action on a limited path: the one of the set-up, or the one that is shown."""


Guard = Callable[[State, Situation], str]  # why it is not allowed just now, "" where it is


def _always(state: State, situation: Situation) -> str:
    return ""


@dataclass(frozen=True, slots=True)
class Rule:
    """A command: the states it is allowed in, the state after it, what it does, what it takes, its guard.

    `after` None leaves the state as it is. `takes` None: whatever comes with it is not looked at, because a stop
    is not refused for a word too many.
    """

    allowed: tuple[State, ...]
    after: State | Mapping[State, State] | None
    effect: Callable[[Effects, Any], Told | None]
    takes: type[Section] | None = Nothing
    guard: Guard = _always

    def next(self, state: State) -> State | None:
        """The state after it, None for the same."""
        return self.after.get(state) if isinstance(self.after, Mapping) else self.after


def _untried(state: State, situation: Situation) -> str:
    return "the open run is one of a trial: what is measured may not be changed" if situation.trial else ""


def _may_step(state: State, situation: Situation) -> str:
    if situation.mode not in ("step", "preview"):
        return f"the run's mode is {situation.mode}, and step is for step and preview"
    if situation.proposed:
        return "a chunk is shown: commit or cancel it first"
    if situation.asked:
        return "the policy is being asked"
    return "the last chunk is still being executed" if situation.executing else ""


def _may_commit(state: State, situation: Situation) -> str:
    if situation.mode != "preview":
        return f"the run's mode is {situation.mode}, and commit is for preview"
    return "" if situation.proposed else "no chunk is shown: step first"


def _may_cancel(state: State, situation: Situation) -> str:
    if situation.mode in ("step", "preview", "manual"):
        return ""
    return f"the run's mode is {situation.mode}, and cancel is for step, preview and manual: stop or halt it"


def _may_move(state: State, situation: Situation) -> str:
    if situation.mode == "manual":
        return ""
    return f"the run's mode is {situation.mode}, and move is for manual"


def _may_approach(state: State, situation: Situation) -> str:
    if state is State.READY:
        return "" if situation.first_action else "the policy's first action is not known: set up again"
    if situation.mode != "preview":
        return f"the run's mode is {situation.mode}, and approach is for preview"
    return "" if situation.proposed else "no chunk is shown: step first"


S = State
_STOPPED = "stopped by the operator"
COMMANDS: dict[str, Rule] = {
    "setup": Rule((S.IDLE, S.READY), S.SETTING_UP, lambda e, asked: e.begin_setup(asked), SetUpRequest),
    "run": Rule((S.READY,), S.RUNNING, lambda e, asked: e.begin_run(asked), RunRequest),
    "stop": Rule(
        (S.RUNNING, S.HOLDING, S.READY), S.READY, lambda e, _: e.end_run("finished", _STOPPED), None
    ),
    "halt": Rule((S.RUNNING, S.HOLDING), S.HOLDING, lambda e, _: e.hold("halted by the operator"), None),
    "resume": Rule((S.HOLDING,), S.RUNNING, lambda e, _: e.resume_run()),
    "home": Rule((S.READY,), S.SETTING_UP, lambda e, _: e.go_home()),
    "release": Rule((S.FAULTED,), None, lambda e, _: e.release_estop()),
    "record_start": Rule((S.IDLE, S.READY), None, lambda e, _: e.start_recording()),
    "record_stop": Rule(
        (S.DISCONNECTED, S.IDLE, S.SETTING_UP, S.READY, S.HOLDING), None, lambda e, _: e.stop_recording()
    ),
    "tune": Rule(
        (S.IDLE, S.READY, S.RUNNING, S.HOLDING), None, lambda e, asked: e.tune(asked), TuneRequest, _untried
    ),
    "step": Rule((S.RUNNING,), None, lambda e, _: e.step(), guard=_may_step),
    "commit": Rule((S.RUNNING,), None, lambda e, _: e.commit(), guard=_may_commit),
    "cancel": Rule((S.RUNNING,), None, lambda e, _: e.cancel(), guard=_may_cancel),
    "move": Rule((S.RUNNING,), None, lambda e, asked: e.move(asked), MoveRequest, _may_move),
    "gripper": Rule(
        (S.READY, S.RUNNING, S.HOLDING), None, lambda e, asked: e.grip(asked), GripperRequest, _untried
    ),
    "approach": Rule(
        (S.READY, S.RUNNING),
        {S.READY: S.SETTING_UP},
        lambda e, _: e.approach(),
        guard=_may_approach,
    ),
}
# While it is being set up, both stopping commands mean the same: cancel.
CANCELLING = ("stop", "halt")
STOPPING = ("stop", "halt", "estop")  # never stale
LEASE_COMMANDS = ("lease_claim", "lease_renew", "lease_give_up")
ANSWERS_KEPT = 5000

# What happens by itself: (happening, state) -> the state after it. Pairs that are not here change nothing.
HAPPENINGS: dict[tuple[Happening, State], State] = {
    (Happening.CONNECTED, S.DISCONNECTED): S.IDLE,
    (Happening.INCOMPLETE, S.DISCONNECTED): S.DISCONNECTED,
    (Happening.DISPLACED, S.READY): S.IDLE,
    (Happening.LINK_LOST, S.IDLE): S.DISCONNECTED,
    (Happening.LINK_LOST, S.READY): S.DISCONNECTED,
    (Happening.LINK_LOST, S.SETTING_UP): S.DISCONNECTED,
    (Happening.SETUP_DONE, S.SETTING_UP): S.READY,
    (Happening.SETUP_FAILED, S.SETTING_UP): S.IDLE,
    (Happening.HELD, S.RUNNING): S.HOLDING,
    (Happening.HELD, S.SETTING_UP): S.IDLE,
    (Happening.RUN_ENDED, S.RUNNING): S.READY,
    (Happening.RUN_ENDED, S.HOLDING): S.READY,
    (Happening.RUN_FAILED, S.RUNNING): S.READY,
    (Happening.RUN_FAILED, S.HOLDING): S.READY,
    (Happening.LEASE_ENDED, S.RUNNING): S.HOLDING,
    (Happening.LEASE_ENDED, S.SETTING_UP): S.IDLE,
    (Happening.RELEASED, S.FAULTED): S.IDLE,
    **{(Happening.ESTOPPED, state): S.FAULTED for state in State if state is not S.FAULTED},
    **{(Happening.FAMILY_DIED, state): S.IDLE for state in (S.READY, S.RUNNING, S.HOLDING, S.SETTING_UP)},
}


class Session:
    """Holds the state; `handle` and `observe` are the only places that change it."""

    def __init__(self, effects: Effects, lease: Lease, boot: str, now: Callable[[], float]) -> None:
        self._effects = effects
        self._lease = lease
        self._boot = boot
        self._now = now
        self.state = State.DISCONNECTED
        self.reason = "waiting for the first observation"
        self.sequence = 0
        self._answers: dict[str, Ack] = {}

    def remember(self, answers: dict[str, Ack]) -> None:
        """Answers given before a restart: the same uuid gets the same answer, and no epoch comes again."""
        self._answers = answers | self._answers
        epochs = [ack.data.get("epoch") for ack in answers.values()]
        self._lease.never_below(max((e for e in epochs if isinstance(e, int)), default=0))

    def allowed(self) -> list[str]:
        """The commands that would be accepted now."""
        situation = self._effects.situation
        commands = [
            kind
            for kind, rule in COMMANDS.items()
            if self.state in rule.allowed and not rule.guard(self.state, situation)
        ]
        if self.state is State.SETTING_UP:
            commands.extend(CANCELLING)
        return [*commands, "estop"]

    def handle(self, command: Command) -> Ack:
        """The answer to `command`; repeated uuids get the first answer again.

        A uuid that was another command's is no repetition: a stop is obeyed all the same, the rest refused.
        """
        if not command.uuid:  # all such commands would be repetitions of each other
            return self._ack(command, "refused", "a command needs a uuid of its own")
        first = self._answers.get(command.uuid)
        if first is not None and first.kind in ("", command.kind):
            return first
        if first is not None and command.kind not in STOPPING:
            return self._ack(command, "refused", f"its uuid was given to the command {first.kind!r} before")
        refusal, told = self._refusal(command), None
        if not refusal:
            try:
                told = self._carry_out(command)
            except RuntimeFault as error:
                refusal = str(error)
        ack = self._ack(command, "refused" if refusal else "accepted", refusal, told)
        if command.kind != "lease_renew":  # a stream, not a discrete command: nothing to repeat
            self._answers.setdefault(command.uuid, ack)
            if len(self._answers) > ANSWERS_KEPT:
                del self._answers[next(iter(self._answers))]
        return ack

    def observe(self, happening: Happening, reason: str = "") -> bool:
        """Tell the session what happened; True where the state changed.

        A RuntimeFault of an effect passes through, with the state as it was: nobody is there to be refused.
        """
        after = HAPPENINGS.get((happening, self.state))
        if after is None or (after is self.state and reason == self.reason):
            return False
        before = self.state
        if happening in (Happening.HELD, Happening.LEASE_ENDED, Happening.LINK_LOST):
            self._stop_for(before, reason)
        elif happening in (Happening.ESTOPPED, Happening.FAMILY_DIED):
            self._interrupt(before, reason)
        elif happening is Happening.RUN_ENDED:
            self._effects.end_run("finished", reason)
        elif happening is Happening.RUN_FAILED:
            self._effects.end_run("failed", reason)
        self._enter(after, reason)
        return True

    def _stop_for(self, before: State, reason: str) -> None:
        if before is State.SETTING_UP:
            self._effects.cancel_setup(reason)
        self._effects.hold(reason)

    def _interrupt(self, before: State, reason: str) -> None:
        if before is State.SETTING_UP:
            self._effects.cancel_setup(reason)
        self._effects.end_run("interrupted", reason)

    def _refusal(self, command: Command) -> str:
        if command.kind in LEASE_COMMANDS:
            return ""
        if command.kind not in COMMANDS and command.kind != "estop":
            return (
                f"unknown command {command.kind!r}; known: {', '.join([*COMMANDS, 'estop', *LEASE_COMMANDS])}"
            )
        if command.kind not in STOPPING:
            stale = self._staleness(command)
            if stale:
                return stale
        if command.kind != "estop":
            refusal = self._lease.check(command.holder, command.epoch, self._now())
            if refusal:
                return refusal
        return self._not_now(command.kind)

    def _staleness(self, command: Command) -> str:
        if command.boot != self._boot:
            return "stale: it was decided before the runtime was restarted"
        if command.sequence < self.sequence:
            return f"stale: the state has changed since it was decided (now {self.state}: {self.reason})"
        if not self._now() <= command.valid_until:  # NaN included
            return "stale: it arrived after its deadline"
        return ""

    def _not_now(self, kind: str) -> str:
        allowed = self.allowed()
        if kind in allowed:
            return ""
        why = f"while {self.state} ({self.reason})"
        if self.state in COMMANDS[kind].allowed:
            why = f"now: {COMMANDS[kind].guard(self.state, self._effects.situation)}"
        return f"{kind} is not allowed {why}; allowed: {', '.join(allowed)}"

    def _carry_out(self, command: Command) -> Told | None:
        """Do it; raises RuntimeFault where something in it, or who is to do it, refuses."""
        if command.kind in LEASE_COMMANDS:
            self._lease_command(command)
            return None
        if command.kind == "estop":
            raise RuntimeFault("the e-stop has a socket of its own: send it to the guard")
        rule = COMMANDS[command.kind]
        if self.state is State.SETTING_UP and command.kind in CANCELLING:
            rule = _CANCEL
        asked = read(command.kind, rule.takes, command.args) if rule.takes else None
        told = rule.effect(self._effects, asked)
        after = rule.next(self.state)
        if after:
            reason = _CANCELLED if rule is _CANCEL else _REASONS.get(command.kind, "")
            self._enter(after, reason)
        return told

    def _lease_command(self, command: Command) -> None:
        now = self._now()
        before = self._lease.current(now)
        act = {
            "lease_claim": self._lease.claim,
            "lease_renew": self._lease.renew,
            "lease_give_up": self._lease.give_up,
        }[command.kind]
        refusal = act(command.holder, command.epoch, now)
        after = self._lease.current(now)
        if (before and before.epoch) != (after and after.epoch):
            self.sequence += 1
        if refusal:
            raise RuntimeFault(refusal)

    def _enter(self, state: State, reason: str) -> None:
        self.state, self.reason = state, reason
        self.sequence += 1

    def _ack(self, command: Command, status: AckStatus, reason: str, told: Told | None = None) -> Ack:
        held = self._lease.current(self._now())
        lease = {"epoch": held.epoch, "holder": held.holder} if held else {}
        data = {**(told or {}), **lease}
        return Ack(
            command.uuid, status, reason, self.allowed(), self._boot, self.sequence, data, command.kind
        )


_CANCELLED = "set-up cancelled by the operator"
_CANCEL = Rule((S.SETTING_UP,), S.IDLE, lambda e, _: e.cancel_setup(_CANCELLED), None)
_REASONS = {
    "stop": _STOPPED,
    "halt": "halted by the operator: resume or stop",
    "home": "going home",
    "setup": "setting up",
    "approach": "going to the policy's first action",
}
