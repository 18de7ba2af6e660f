"""The life of a trial: one table says what may follow what."""

from __future__ import annotations

from enum import StrEnum

from evaweb.errors import Conflict
from evaweb.trials.models import Trial, TrialStatus
from runtime.core.sentences import Pattern

_TRIAL_CANNOT = Pattern(
    "trials.lifecycle.trial_cannot",
    "trial {trial} is {label} and cannot be {move}: {advice}",
)


class Transition(StrEnum):
    """Moves of a trial; the value is the word for it in a sentence."""

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


_S = TrialStatus
TRANSITIONS: dict[tuple[TrialStatus, Transition], TrialStatus] = {
    (_S.PREPARED, Transition.RUN): _S.RUNNING,
    (_S.PREPARED, Transition.ABANDON): _S.ABANDONED,
    (_S.ABANDONED, Transition.RUN): _S.RUNNING,  # it was given up, then the lost answer says that it runs
    (_S.RUNNING, Transition.GIVE_BACK): _S.PREPARED,  # its recording could not be opened: it never ran
    (_S.PAUSED, Transition.GIVE_BACK): _S.PREPARED,
    (_S.RUNNING, Transition.PAUSE): _S.PAUSED,
    (_S.RUNNING, Transition.END): _S.ENDED,
    (_S.RUNNING, Transition.INTERRUPT): _S.INTERRUPTED,
    (_S.PAUSED, Transition.RESUME): _S.RUNNING,
    (_S.PAUSED, Transition.END): _S.ENDED,
    (_S.PAUSED, Transition.INTERRUPT): _S.INTERRUPTED,
    (_S.ENDED, Transition.INTERRUPT): _S.INTERRUPTED,  # its recording turns out not to be whole
    (_S.ENDED, Transition.SCORE): _S.SCORED,
    (_S.ENDED, Transition.VOID): _S.VOIDED,
    # An e-stop may well be the checkpoint's own failure: leaving such trials out would flatter it.
    (_S.INTERRUPTED, Transition.SCORE): _S.SCORED,
    (_S.INTERRUPTED, Transition.VOID): _S.VOIDED,
    (_S.SCORED, Transition.SCORE): _S.SCORED,  # a correction
    (_S.SCORED, Transition.VOID): _S.VOIDED,
    (_S.SCORED, Transition.ASK): _S.VOID_ASKED,  # of a blind plan: a second operator has to agree
    (_S.VOID_ASKED, Transition.VOID): _S.VOIDED,
    (_S.VOID_ASKED, Transition.KEEP): _S.SCORED,
}

OPEN_STATES = (_S.PREPARED, _S.RUNNING, _S.PAUSED)
RUNNING_STATES = (_S.RUNNING, _S.PAUSED)
SCORED_STATES = (_S.SCORED, _S.VOID_ASKED, _S.VOIDED)
REPEATABLE_STATES = (_S.INTERRUPTED, _S.VOID_ASKED, _S.VOIDED, _S.ABANDONED)
"""What does not count: the next trial of the same kind is another attempt of the same number."""

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
}


def advice(status: str) -> str:
    """Advice to a person on a trial in this status."""
    return _ADVICE[TrialStatus(status)]


def allows(trial: Trial, move: Transition) -> bool:
    """True if `move` is in the table for this trial as it stands."""
    return (TrialStatus(trial.status), move) in TRANSITIONS


def require(trial: Trial, move: Transition) -> None:
    """Raise Conflict, with what can be done instead, unless the table has `move` for this trial."""
    if not allows(trial, move):
        status = TrialStatus(trial.status)
        raise Conflict(_TRIAL_CANNOT(trial=trial.pk, label=status.label, move=move, advice=advice(status)))


def apply(trial: Trial, move: Transition) -> None:
    """Set the status that follows; the caller saves. Conflict where the table has no such move."""
    require(trial, move)
    trial.status = TRANSITIONS[TrialStatus(trial.status), move]
