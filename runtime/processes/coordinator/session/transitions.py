"""All transitions of a station's session: allowed commands by state, and transitions by events."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any

from runtime.core.sentences import Pattern, fixed
from runtime.ipc.messages import Mode
from runtime.ipc.session_state import SessionState

if TYPE_CHECKING:
    from runtime.processes.coordinator.operations import SessionActions

_NO_COLLECTION = fixed(
    "session.no_collection",
    "this station collects nothing: its deployment has no [collection]",
)
_NOT_ARMED = fixed("session.not_armed", "the station is set up to collect and is not armed: arm first")
_DEMONSTRATION_NOT_ARMED = fixed(
    "session.demonstration_not_armed",
    "a demonstration is open and the station is not armed: arm first, or stop",
)
_SET_UP_WITH_POLICY = fixed(
    "session.set_up_with_policy",
    "the station is set up with a policy: set up with collect first",
)
_ARMED_ALREADY = fixed("session.armed_already", "it is armed already")
_NOT_ARMED_AT_ALL = fixed("session.not_armed_at_all", "it is not armed")
_TRIAL_OPEN = fixed(
    "session.trial_open",
    "the open run is one of a trial: what is measured may not be changed",
)
_OPENING = fixed(
    "session.opening",
    "the run has not begun, its recording is being opened: try again in a moment",
)
_MODE_WITHOUT_STEP = Pattern(
    "session.mode_without_step",
    "the run's mode is {mode}, and step is for step and preview",
)
_CHUNK_SHOWN = fixed("session.chunk_shown", "a chunk is shown: commit or cancel it first")
_POLICY_ASKED = fixed("session.policy_asked", "the policy is being asked")
_CHUNK_EXECUTING = fixed("session.chunk_executing", "the last chunk is still being executed")
_MODE_WITHOUT_COMMIT = Pattern(
    "session.mode_without_commit",
    "the run's mode is {mode}, and commit is for preview",
)
_APPROACHING = fixed(
    "session.approaching",
    "the robot is moving to the start of the chunk: wait, or cancel",
)
_NO_CHUNK_SHOWN = fixed("session.no_chunk_shown", "no chunk is shown: step first")
_MODE_WITHOUT_CANCEL = Pattern(
    "session.mode_without_cancel",
    "the run's mode is {mode}, and cancel is for step, preview and manual: stop or halt it",
)
_MODE_WITHOUT_MOVE = Pattern("session.mode_without_move", "the run's mode is {mode}, and move is for manual")
_FIRST_ACTION_UNKNOWN = fixed(
    "session.first_action_unknown",
    "the policy's first action is not known: set up again",
)
_MODE_WITHOUT_APPROACH = Pattern(
    "session.mode_without_approach",
    "the run's mode is {mode}, and approach is for preview",
)
STOPPED = fixed("session.stopped", "stopped by the operator")
_HALTED = fixed("session.halted", "halted by the operator")
CANCELLED = fixed("session.setup_cancelled", "set-up cancelled by the operator")
_HALTED_WAITS = fixed("session.halted_waits", "halted by the operator: resume or stop")
_GOING_HOME = fixed("session.going_home", "going home")
_SETTING_UP = fixed("session.setting_up", "setting up")
_APPROACHING_FIRST = fixed("session.approaching_first", "going to the policy's first action")
DISCARDED = fixed("session.discarded", "discarded by the operator")

TransitionResult = Mapping[str, Any]  # for the data of an answer


class SessionEvent(StrEnum):
    """Events from other parts of the runtime for the session."""

    CONNECTED = "connected"  # a complete observation arrived
    INCOMPLETE = "incomplete"  # observations arrive, but not from every camera
    DISPLACED = "displaced"  # the arm is not at its commanded position
    LINK_LOST = "link_lost"  # no observation for a long time
    SETUP_DONE = "setup_done"
    SETUP_FAILED = "setup_failed"
    HELD = "held"  # control holds, for a reason of its own
    RUN_ENDED = "run_ended"  # the run ended by itself: its duration, its source
    RUN_FAILED = "run_failed"  # it could not begin, or failed
    LEASE_ENDED = "lease_ended"
    HOLDER_LOST = "holder_lost"  # the lease holder is lost, but the run continues
    ESTOPPED = "estopped"
    RELEASED = "released"
    FAMILY_DIED = "family_died"  # a station process was restarted


@dataclass(frozen=True, slots=True)
class GuardFacts:
    """Facts that decide, in addition to the session's state, whether a command is allowed."""

    mode: Mode | None = None  # of the open run
    trial: bool = False  # the open run is a trial: what is measured must not change
    has_proposal: bool = False  # a chunk is shown and waits to be committed
    is_requesting: bool = False  # a request is in flight, or its chunk is not merged
    executing: bool = False  # steps are planned
    first_action: bool = False  # the policy's first action is known from the last set-up
    opening: bool = False  # the open run has not begun: its recording is being opened
    approaching: bool = False  # the robot is moving to the start of the shown chunk
    collection: bool = False  # the deployment configures collection
    collecting: bool = False  # it is set up to collect
    armed: bool = False  # a person has permitted demonstrations to begin
    leader_problem: str = ""  # why the leader cannot be followed now
    doubt: str = ""  # why no motion may begin: joints implausible, or not at the commanded position


Guard = Callable[[SessionState, GuardFacts], str]  # returns why it is not allowed now, "" if it is


def _always(state: SessionState, situation: GuardFacts) -> str:
    return ""


def _placed(guard: Guard = _always) -> Guard:
    """Return `guard` extended for commands that begin a motion.

    The joints must also be plausible, and be at their held position.
    """
    return lambda state, situation: guard(state, situation) or situation.doubt


@dataclass(frozen=True, slots=True)
class Rule:
    """Rule of a command: the states in which it is allowed, the state after it, its effect, its guard.

    `after` is the state after the command, or maps the state before it to the state after it; None leaves the state
    unchanged. Arguments are declared in runtime.ipc.command_arguments.ARGUMENTS. `effect` raises RuntimeFault to
    refuse, and has then changed nothing; its return value becomes part of the answer.
    """

    allowed: tuple[SessionState, ...]
    after: SessionState | Mapping[SessionState, SessionState] | None
    effect: Callable[[SessionActions, Any], TransitionResult | None]
    guard: Guard = _always
    stays: Callable[[Any], bool] = lambda asked: False  # whether the state is unchanged, by the arguments

    def next(self, state: SessionState, asked: Any = None) -> SessionState | None:
        """Return the state after the command; None if the command leaves the state unchanged.

        `state` is the state before the command, and `asked` are the arguments of the command.
        """
        if self.stays(asked):
            return None
        return self.after.get(state) if isinstance(self.after, Mapping) else self.after


def _may_run(state: SessionState, situation: GuardFacts) -> str:
    unarmed = situation.collecting and not situation.armed
    return _NOT_ARMED if unarmed else ""


def _may_resume(state: SessionState, situation: GuardFacts) -> str:
    unarmed = situation.mode == "collect" and not situation.armed
    return _DEMONSTRATION_NOT_ARMED if unarmed else ""


def _may_collect(state: SessionState, situation: GuardFacts) -> str:
    return "" if situation.collection else _NO_COLLECTION


def _may_arm(state: SessionState, situation: GuardFacts) -> str:
    if not situation.collection:
        return _NO_COLLECTION
    if not situation.collecting:
        return _SET_UP_WITH_POLICY
    return _ARMED_ALREADY if situation.armed else situation.leader_problem


def _may_disarm(state: SessionState, situation: GuardFacts) -> str:
    if not situation.collection:
        return _NO_COLLECTION
    return "" if situation.armed else _NOT_ARMED_AT_ALL


def _approach_problem(state: SessionState, situation: GuardFacts) -> str:
    return _TRIAL_OPEN if situation.trial else ""


def _may_grip(state: SessionState, situation: GuardFacts) -> str:
    if state is SessionState.RUNNING and situation.opening:
        return _OPENING
    return _approach_problem(state, situation)


def _may_step(state: SessionState, situation: GuardFacts) -> str:
    if situation.mode not in ("step", "preview"):
        return _MODE_WITHOUT_STEP(mode=situation.mode)
    if situation.opening:  # a request now would be discarded when the run begins
        return _OPENING
    if situation.has_proposal:
        return _CHUNK_SHOWN
    if situation.is_requesting:
        return _POLICY_ASKED
    return _CHUNK_EXECUTING if situation.executing else ""


def _may_commit(state: SessionState, situation: GuardFacts) -> str:
    if situation.mode != "preview":
        return _MODE_WITHOUT_COMMIT(mode=situation.mode)
    if situation.approaching:  # control would drop the chunk, and it would be lost
        return _APPROACHING
    return "" if situation.has_proposal else _NO_CHUNK_SHOWN


def _may_cancel(state: SessionState, situation: GuardFacts) -> str:
    if situation.mode in ("step", "preview", "manual"):
        return _OPENING if situation.opening else ""
    return _MODE_WITHOUT_CANCEL(mode=situation.mode)


def _may_move(state: SessionState, situation: GuardFacts) -> str:
    if situation.mode == "manual":
        return _OPENING if situation.opening else ""
    return _MODE_WITHOUT_MOVE(mode=situation.mode)


def _may_approach(state: SessionState, situation: GuardFacts) -> str:
    if state is SessionState.READY:
        return "" if situation.first_action else _FIRST_ACTION_UNKNOWN
    if situation.mode != "preview":
        return _MODE_WITHOUT_APPROACH(mode=situation.mode)
    return "" if situation.has_proposal else _NO_CHUNK_SHOWN


S = SessionState
COMMANDS: dict[str, Rule] = {
    "setup": Rule((S.IDLE, S.READY), S.SETTING_UP, lambda do, asked: do.begin_setup(asked)),
    "run": Rule((S.READY,), S.RUNNING, lambda do, asked: do.begin_run(asked), guard=_placed(_may_run)),
    "stop": Rule((S.RUNNING, S.HOLDING, S.READY), S.READY, lambda do, _: do.end_run("finished", STOPPED)),
    "halt": Rule((S.RUNNING, S.HOLDING), S.HOLDING, lambda do, _: do.hold(_HALTED)),
    "resume": Rule((S.HOLDING,), S.RUNNING, lambda do, _: do.resume_run(), guard=_placed(_may_resume)),
    "home": Rule((S.READY,), S.SETTING_UP, lambda do, _: do.go_home(), guard=_placed()),
    "release": Rule((S.FAULTED,), None, lambda do, _: do.shared.request_release()),
    "record_start": Rule((S.IDLE, S.READY), None, lambda do, _: do.start_recording()),
    "record_stop": Rule(
        (S.DISCONNECTED, S.IDLE, S.SETTING_UP, S.READY, S.HOLDING),
        None,
        lambda do, _: do.runs.stop_standalone_recording(),
    ),
    "tune": Rule(
        (S.IDLE, S.READY, S.RUNNING, S.HOLDING),
        None,
        lambda do, asked: do.tune(asked),
        guard=_approach_problem,
    ),
    "step": Rule((S.RUNNING,), None, lambda do, _: do.inference.step(), guard=_placed(_may_step)),
    "commit": Rule((S.RUNNING,), None, lambda do, _: do.inference.commit(), guard=_placed(_may_commit)),
    "cancel": Rule((S.RUNNING,), None, lambda do, _: do.cancel(), guard=_may_cancel),
    "move": Rule((S.RUNNING,), None, lambda do, asked: do.manual.move(asked), guard=_placed(_may_move)),
    "gripper": Rule(
        (S.READY, S.RUNNING, S.HOLDING),
        None,
        lambda do, asked: do.move_gripper(asked),
        guard=_placed(_may_grip),
    ),
    "approach": Rule(
        (S.READY, S.RUNNING),
        {S.READY: S.SETTING_UP},
        lambda do, _: do.approach(),
        guard=_placed(_may_approach),
    ),
    "arm": Rule((S.READY, S.HOLDING), None, lambda do, _: do.arm(), guard=_may_arm),
    "disarm": Rule(
        (S.READY, S.HOLDING), None, lambda do, _: do.collecting.disarm(f"by {do.by}"), guard=_may_disarm
    ),
    "label": Rule(
        tuple(SessionState), None, lambda do, asked: do.collecting.label(asked, do.by), guard=_may_collect
    ),
    "discard": Rule(
        tuple(SessionState),
        {S.RUNNING: S.READY, S.HOLDING: S.READY},
        lambda do, asked: do.discard(asked),
        guard=_may_collect,
        stays=lambda asked: asked is not None and asked.episode is not None,
    ),
}
# During a set-up both stopping commands cancel it.
CANCELLING = ("stop", "halt")
STOPPING = ("stop", "halt", "estop")  # never stale
# Transitions by events: (event, state) -> next state. Other pairs change nothing.
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
    (SessionEvent.HOLDER_LOST, S.RUNNING): S.RUNNING,
    (SessionEvent.RELEASED, S.FAULTED): S.IDLE,
    **{(SessionEvent.ESTOPPED, state): S.FAULTED for state in SessionState if state is not S.FAULTED},
    **{(SessionEvent.FAMILY_DIED, state): S.IDLE for state in (S.READY, S.RUNNING, S.HOLDING, S.SETTING_UP)},
}

# A gripper may be moving in these states although no run is executed: the end of the lease stops it, and no
# more.
MOVED_BY_HAND = (S.READY, S.HOLDING)

CANCEL = Rule((S.SETTING_UP,), S.IDLE, lambda do, _: do.cancel_setup(CANCELLED))
REASONS = {
    "stop": STOPPED,
    "halt": _HALTED_WAITS,
    "home": _GOING_HOME,
    "setup": _SETTING_UP,
    "approach": _APPROACHING_FIRST,
    "discard": DISCARDED,
}
