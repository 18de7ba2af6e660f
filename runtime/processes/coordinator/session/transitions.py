"""Every transition of a station's session: which command is allowed when, and what follows from what happens."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from runtime.ipc.session_state import SessionState
from runtime.processes.coordinator.session.effects import Effects, GuardFacts, Told


class SessionEvent(StrEnum):
    """Events that the rest of the runtime tells the session."""

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


Guard = Callable[[SessionState, GuardFacts], str]  # why it is not allowed just now, "" where it is


def _always(state: SessionState, situation: GuardFacts) -> str:
    return ""


def _placed(guard: Guard = _always) -> Guard:
    """`guard` of a command that begins to move the robot: its joints are where they are held as well."""
    return lambda state, situation: guard(state, situation) or situation.doubt


@dataclass(frozen=True, slots=True)
class Rule:
    """A command: the states it is allowed in, the state after it, what it does, its guard.

    `after` None leaves the state as it is. What a command takes is in runtime.ipc.command_arguments.ARGUMENTS.
    """

    allowed: tuple[SessionState, ...]
    after: SessionState | Mapping[SessionState, SessionState] | None
    effect: Callable[[Effects, Any], Told | None]
    guard: Guard = _always
    stays: Callable[[Any], bool] = lambda asked: False  # by what it took, whether the state is left as it is

    def next(self, state: SessionState, asked: Any = None) -> SessionState | None:
        """The state after it, None for the same; `asked` is what it took."""
        if self.stays(asked):
            return None
        return self.after.get(state) if isinstance(self.after, Mapping) else self.after


_NO_COLLECTION = "this station collects nothing: its deployment has no [collection]"


def _may_run(state: SessionState, situation: GuardFacts) -> str:
    unarmed = situation.collecting and not situation.armed
    return "the station is set up to collect and is not armed: arm first" if unarmed else ""


def _may_resume(state: SessionState, situation: GuardFacts) -> str:
    unarmed = situation.mode == "collect" and not situation.armed
    return "a demonstration is open and the station is not armed: arm first, or stop" if unarmed else ""


def _may_collect(state: SessionState, situation: GuardFacts) -> str:
    return "" if situation.collection else _NO_COLLECTION


def _may_arm(state: SessionState, situation: GuardFacts) -> str:
    if not situation.collection:
        return _NO_COLLECTION
    if not situation.collecting:
        return "the station is set up with a policy: set up with collect first"
    return "it is armed already" if situation.armed else situation.unled


def _may_disarm(state: SessionState, situation: GuardFacts) -> str:
    if not situation.collection:
        return _NO_COLLECTION
    return "" if situation.armed else "it is not armed"


def _untried(state: SessionState, situation: GuardFacts) -> str:
    return "the open run is one of a trial: what is measured may not be changed" if situation.trial else ""


_OPENING = "the run has not begun, its recording is being opened: try again in a moment"


def _may_grip(state: SessionState, situation: GuardFacts) -> str:
    if state is SessionState.RUNNING and situation.opening:
        return _OPENING
    return _untried(state, situation)


def _may_step(state: SessionState, situation: GuardFacts) -> str:
    if situation.mode not in ("step", "preview"):
        return f"the run's mode is {situation.mode}, and step is for step and preview"
    if situation.opening:  # what is asked for now would be forgotten when it begins
        return _OPENING
    if situation.proposed:
        return "a chunk is shown: commit or cancel it first"
    if situation.asked:
        return "the policy is being asked"
    return "the last chunk is still being executed" if situation.executing else ""


def _may_commit(state: SessionState, situation: GuardFacts) -> str:
    if situation.mode != "preview":
        return f"the run's mode is {situation.mode}, and commit is for preview"
    if situation.approaching:  # control would not take the chunk, and it would be gone
        return "the robot is on its way to where the chunk begins: wait, or cancel"
    return "" if situation.proposed else "no chunk is shown: step first"


def _may_cancel(state: SessionState, situation: GuardFacts) -> str:
    if situation.mode in ("step", "preview", "manual"):
        return _OPENING if situation.opening else ""
    return f"the run's mode is {situation.mode}, and cancel is for step, preview and manual: stop or halt it"


def _may_move(state: SessionState, situation: GuardFacts) -> str:
    if situation.mode == "manual":
        return _OPENING if situation.opening else ""
    return f"the run's mode is {situation.mode}, and move is for manual"


def _may_approach(state: SessionState, situation: GuardFacts) -> str:
    if state is SessionState.READY:
        return "" if situation.first_action else "the policy's first action is not known: set up again"
    if situation.mode != "preview":
        return f"the run's mode is {situation.mode}, and approach is for preview"
    return "" if situation.proposed else "no chunk is shown: step first"


S = SessionState
_STOPPED = "stopped by the operator"
COMMANDS: dict[str, Rule] = {
    "setup": Rule((S.IDLE, S.READY), S.SETTING_UP, lambda e, asked: e.begin_setup(asked)),
    "run": Rule((S.READY,), S.RUNNING, lambda e, asked: e.begin_run(asked), guard=_placed(_may_run)),
    "stop": Rule((S.RUNNING, S.HOLDING, S.READY), S.READY, lambda e, _: e.end_run("finished", _STOPPED)),
    "halt": Rule((S.RUNNING, S.HOLDING), S.HOLDING, lambda e, _: e.hold("halted by the operator")),
    "resume": Rule((S.HOLDING,), S.RUNNING, lambda e, _: e.resume_run(), guard=_placed(_may_resume)),
    "home": Rule((S.READY,), S.SETTING_UP, lambda e, _: e.go_home(), guard=_placed()),
    "release": Rule((S.FAULTED,), None, lambda e, _: e.release_estop()),
    "record_start": Rule((S.IDLE, S.READY), None, lambda e, _: e.start_recording()),
    "record_stop": Rule(
        (S.DISCONNECTED, S.IDLE, S.SETTING_UP, S.READY, S.HOLDING), None, lambda e, _: e.stop_recording()
    ),
    "tune": Rule(
        (S.IDLE, S.READY, S.RUNNING, S.HOLDING), None, lambda e, asked: e.tune(asked), guard=_untried
    ),
    "step": Rule((S.RUNNING,), None, lambda e, _: e.step(), guard=_placed(_may_step)),
    "commit": Rule((S.RUNNING,), None, lambda e, _: e.commit(), guard=_placed(_may_commit)),
    "cancel": Rule((S.RUNNING,), None, lambda e, _: e.cancel(), guard=_may_cancel),
    "move": Rule((S.RUNNING,), None, lambda e, asked: e.move(asked), guard=_placed(_may_move)),
    "gripper": Rule(
        (S.READY, S.RUNNING, S.HOLDING), None, lambda e, asked: e.grip(asked), guard=_placed(_may_grip)
    ),
    "approach": Rule(
        (S.READY, S.RUNNING),
        {S.READY: S.SETTING_UP},
        lambda e, _: e.approach(),
        guard=_placed(_may_approach),
    ),
    "arm": Rule((S.READY, S.HOLDING), None, lambda e, _: e.arm(), guard=_may_arm),
    "disarm": Rule((S.READY, S.HOLDING), None, lambda e, _: e.disarm(), guard=_may_disarm),
    "label": Rule(tuple(SessionState), None, lambda e, asked: e.label(asked), guard=_may_collect),
    "discard": Rule(
        tuple(SessionState),
        {S.RUNNING: S.READY, S.HOLDING: S.READY},
        lambda e, asked: e.discard(asked),
        guard=_may_collect,
        stays=lambda asked: asked is not None and asked.episode is not None,
    ),
}
# While it is being set up, both stopping commands mean the same: cancel.
CANCELLING = ("stop", "halt")
STOPPING = ("stop", "halt", "estop")  # never stale
# What happens by itself: (happening, state) -> the state after it. Pairs that are not here change nothing.
EVENT_TRANSITIONS: dict[tuple[SessionEvent, SessionState], SessionState] = {
    (SessionEvent.CONNECTED, S.DISCONNECTED): S.IDLE,
    (SessionEvent.INCOMPLETE, S.DISCONNECTED): S.DISCONNECTED,
    (SessionEvent.DISPLACED, S.READY): S.IDLE,
    (SessionEvent.LINK_LOST, S.IDLE): S.DISCONNECTED,
    (SessionEvent.LINK_LOST, S.READY): S.DISCONNECTED,
    (SessionEvent.LINK_LOST, S.SETTING_UP): S.DISCONNECTED,
    (SessionEvent.SETUP_DONE, S.SETTING_UP): S.READY,
    (SessionEvent.SETUP_FAILED, S.SETTING_UP): S.IDLE,
    (SessionEvent.HELD, S.RUNNING): S.HOLDING,
    (SessionEvent.HELD, S.SETTING_UP): S.IDLE,
    (SessionEvent.RUN_ENDED, S.RUNNING): S.READY,
    (SessionEvent.RUN_ENDED, S.HOLDING): S.READY,
    (SessionEvent.RUN_FAILED, S.RUNNING): S.READY,
    (SessionEvent.RUN_FAILED, S.HOLDING): S.READY,
    (SessionEvent.LEASE_ENDED, S.RUNNING): S.HOLDING,
    (SessionEvent.LEASE_ENDED, S.SETTING_UP): S.IDLE,
    (SessionEvent.RELEASED, S.FAULTED): S.IDLE,
    **{(SessionEvent.ESTOPPED, state): S.FAULTED for state in SessionState if state is not S.FAULTED},
    **{(SessionEvent.FAMILY_DIED, state): S.IDLE for state in (S.READY, S.RUNNING, S.HOLDING, S.SETTING_UP)},
}

# A gripper may be on its way in these, although no run goes on: the end of the lease stops it, and no more.
MOVED_BY_HAND = (S.READY, S.HOLDING)
CANCELLED = "set-up cancelled by the operator"
CANCEL = Rule((S.SETTING_UP,), S.IDLE, lambda e, _: e.cancel_setup(CANCELLED))
REASONS = {
    "stop": _STOPPED,
    "halt": "halted by the operator: resume or stop",
    "home": "going home",
    "setup": "setting up",
    "approach": "going to the policy's first action",
    "discard": "discarded by the operator",
}
