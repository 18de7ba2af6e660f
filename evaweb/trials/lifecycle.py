"""Life cycle of a trial: table of allowed transitions."""

from __future__ import annotations

from enum import StrEnum

from evaweb.core.errors import Conflict
from evaweb.trials.models import Trial, TrialStatus
from runtime.core.sentences import Pattern

_TRIAL_CANNOT = Pattern(
    "trials.lifecycle.trial_cannot",
    "trial {trial} is {label} and cannot be {move}: {advice}",
)


class Transition(StrEnum):
    """Transition of a trial; the value is a participle for messages, such as "paused"."""

    RUN = "run"
    PAUSE = "paused"
    RESUME = "resumed"
    GIVE_BACK = "given back"
    END = "ended"
    INTERRUPT = "interrupted"
    SCORE = "scored"
    ASK = "voided by a second operator"
    VOID = "voided"
    KEEP = "kept"
    ABANDON = "abandoned"
    DISMISS = "dismissed"


_S = TrialStatus
TRANSITIONS: dict[tuple[TrialStatus, Transition], TrialStatus] = {
    (_S.PREPARED, Transition.RUN): _S.RUNNING,
    (_S.PREPARED, Transition.ABANDON): _S.ABANDONED,
    (_S.ABANDONED, Transition.RUN): _S.RUNNING,  # abandoned while the answer to its run was lost
    (_S.RUNNING, Transition.GIVE_BACK): _S.PREPARED,  # its recording could not be opened, so it never ran
    (_S.PAUSED, Transition.GIVE_BACK): _S.PREPARED,
    (_S.RUNNING, Transition.PAUSE): _S.PAUSED,
    (_S.RUNNING, Transition.END): _S.ENDED,
    (_S.RUNNING, Transition.INTERRUPT): _S.INTERRUPTED,
    (_S.PAUSED, Transition.RESUME): _S.RUNNING,
    (_S.PAUSED, Transition.END): _S.ENDED,
    (_S.PAUSED, Transition.INTERRUPT): _S.INTERRUPTED,
    (_S.ENDED, Transition.INTERRUPT): _S.INTERRUPTED,  # its recording turns out to be incomplete
    (_S.ENDED, Transition.SCORE): _S.SCORED,
    (_S.ENDED, Transition.VOID): _S.VOIDED,
    # An e-stop may be the checkpoint's own failure: excluding such trials would bias its rate upwards.
    (_S.INTERRUPTED, Transition.SCORE): _S.SCORED,
    (_S.INTERRUPTED, Transition.VOID): _S.VOIDED,
    (_S.SCORED, Transition.SCORE): _S.SCORED,  # a correction
    (_S.SCORED, Transition.VOID): _S.VOIDED,
    (_S.SCORED, Transition.ASK): _S.VOID_ASKED,  # in a blind plan, where a second operator has to agree
    (_S.VOID_ASKED, Transition.VOID): _S.VOIDED,
    (_S.VOID_ASKED, Transition.KEEP): _S.SCORED,
    # Run at the same time as the trial with which the plan's design ended: it is no attempt, and in no figure.
    (_S.PREPARED, Transition.DISMISS): _S.NOT_NEEDED,
    (_S.ENDED, Transition.DISMISS): _S.NOT_NEEDED,
    (_S.INTERRUPTED, Transition.DISMISS): _S.NOT_NEEDED,
}

OPEN_STATES = (_S.PREPARED, _S.RUNNING, _S.PAUSED)
RUNNING_STATES = (_S.RUNNING, _S.PAUSED)
SCORED_STATES = (_S.SCORED, _S.VOID_ASKED, _S.VOIDED)
REPEATABLE_STATES = (_S.INTERRUPTED, _S.VOID_ASKED, _S.VOIDED, _S.ABANDONED)
"""States that do not count: the next trial is another attempt of the same number."""

_ADVICE = {
    _S.PREPARED: "run it, or abandon it",
    _S.RUNNING: "stop it first",
    _S.PAUSED: "resume it, or stop it",
    _S.ENDED: "score it, or void it with a reason",
    _S.INTERRUPTED: "score it, or repeat it as a new attempt",
    _S.SCORED: "correct its score, or void it with a reason",
    _S.VOID_ASKED: "a second operator agrees or refuses on its page",
    _S.VOIDED: "repeat it as a new attempt",
    _S.ABANDONED: "prepare another one",
    _S.NOT_NEEDED: "the plan's design had ended, or dropped its checkpoint, before it",
}


def advice(status: str) -> str:
    """Return advice to the user on a trial in this status."""
    return _ADVICE[TrialStatus(status)]


def allows(trial: Trial, move: Transition) -> bool:
    """Return True if the table has this transition from the trial's status."""
    return (TrialStatus(trial.status), move) in TRANSITIONS


def require(trial: Trial, move: Transition) -> None:
    """Raise Conflict, with advice, unless the table has this transition from the trial's status."""
    if not allows(trial, move):
        status = TrialStatus(trial.status)
        raise Conflict(_TRIAL_CANNOT(trial=trial.pk, label=status.label, move=move, advice=advice(status)))


def apply(trial: Trial, move: Transition) -> None:
    """Set the resulting status without saving. Raises: Conflict if the table lacks the transition."""
    require(trial, move)
    trial.status = TRANSITIONS[TrialStatus(trial.status), move]
