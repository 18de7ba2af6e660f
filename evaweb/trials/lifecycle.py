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


class Move(StrEnum):
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
MOVES: dict[tuple[TrialStatus, Move], TrialStatus] = {
    (_S.PREPARED, Move.RUN): _S.RUNNING,
    (_S.PREPARED, Move.ABANDON): _S.ABANDONED,
    (_S.ABANDONED, Move.RUN): _S.RUNNING,  # it was given up, then the lost answer says that it runs
    (_S.RUNNING, Move.GIVE_BACK): _S.PREPARED,  # its recording could not be opened: it never ran
    (_S.PAUSED, Move.GIVE_BACK): _S.PREPARED,
    (_S.RUNNING, Move.PAUSE): _S.PAUSED,
    (_S.RUNNING, Move.END): _S.ENDED,
    (_S.RUNNING, Move.INTERRUPT): _S.INTERRUPTED,
    (_S.PAUSED, Move.RESUME): _S.RUNNING,
    (_S.PAUSED, Move.END): _S.ENDED,
    (_S.PAUSED, Move.INTERRUPT): _S.INTERRUPTED,
    (_S.ENDED, Move.INTERRUPT): _S.INTERRUPTED,  # its recording turns out not to be whole
    (_S.ENDED, Move.SCORE): _S.SCORED,
    (_S.ENDED, Move.VOID): _S.VOIDED,
    # An e-stop may well be the checkpoint's own failure: leaving such trials out would flatter it.
    (_S.INTERRUPTED, Move.SCORE): _S.SCORED,
    (_S.INTERRUPTED, Move.VOID): _S.VOIDED,
    (_S.SCORED, Move.SCORE): _S.SCORED,  # a correction
    (_S.SCORED, Move.VOID): _S.VOIDED,
    (_S.SCORED, Move.ASK): _S.VOID_ASKED,  # of a blind plan: a second operator has to agree
    (_S.VOID_ASKED, Move.VOID): _S.VOIDED,
    (_S.VOID_ASKED, Move.KEEP): _S.SCORED,
}

OPEN = (_S.PREPARED, _S.RUNNING, _S.PAUSED)
UNDER_WAY = (_S.RUNNING, _S.PAUSED)
JUDGED = (_S.SCORED, _S.VOID_ASKED, _S.VOIDED)
REPEATED = (_S.INTERRUPTED, _S.VOID_ASKED, _S.VOIDED, _S.ABANDONED)
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


def allows(trial: Trial, move: Move) -> bool:
    """True if `move` is in the table for this trial as it stands."""
    return (TrialStatus(trial.status), move) in MOVES


def require(trial: Trial, move: Move) -> None:
    """Raise Conflict, with what can be done instead, unless the table has `move` for this trial."""
    if not allows(trial, move):
        status = TrialStatus(trial.status)
        raise Conflict(_TRIAL_CANNOT(trial=trial.pk, label=status.label, move=move, advice=advice(status)))


def apply(trial: Trial, move: Move) -> None:
    """Set the status that follows; the caller saves. Conflict where the table has no such move."""
    require(trial, move)
    trial.status = MOVES[TrialStatus(trial.status), move]
