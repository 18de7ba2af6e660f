"""Second ratings and preferences as lines of an episode's own journal of verdicts, and back.

They lie beside its scores, DATA/scores/UUID.jsonl: a rating with the trial that it is of, a preference with the one
that was run second, when the other one was there already. Nothing serves these files.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any
from uuid import UUID

from pydantic import AwareDatetime, Field, StrictBool

from evaweb.results.models import Preference, Rating
from evaweb.trials.facts import trial_facts
from evaweb.trials.kept import Kept, KeptTrial, Name, Person, read
from evaweb.trials.models import Trial


class KeptRating(Kept):
    """A line of kind "rating"."""

    uuid: UUID
    trial: KeptTrial
    rater: Person
    at: AwareDatetime
    success: StrictBool
    score: Annotated[float, Field(ge=0, le=1)]
    milestones: tuple[tuple[str, StrictBool], ...] = ()
    failure: Annotated[str, Field(max_length=60)] = ""
    note: str = ""
    blind: StrictBool


class KeptPreference(Kept):
    """A line of kind "preference"; `plan` and `version` name the plan that it is of."""

    uuid: UUID
    plan: Name
    version: Annotated[int, Field(ge=1, lt=2**31)]
    first: KeptTrial
    second: KeptTrial
    rater: Person
    at: AwareDatetime
    outcome: Preference.Outcome
    why: str
    blind: StrictBool


def rating_line(rating: Rating) -> dict[str, Any]:
    """The line of a rating that is about to be saved."""
    plain = ("success", "score", "milestones", "failure", "note", "blind")
    return {
        "kind": "rating",
        "uuid": str(rating.uuid),
        "trial": trial_facts(rating.trial),
        "rater": rating.rater.get_username(),
        "at": rating.at.isoformat(),
        **{name: getattr(rating, name) for name in plain},
    }


def preference_line(row: Preference) -> dict[str, Any]:
    """The line of a preference that is about to be saved."""
    assert row.plan is not None
    return {
        "kind": "preference",
        "uuid": str(row.uuid),
        "plan": row.plan.name,
        "version": row.plan.version,
        "first": trial_facts(row.first),
        "second": trial_facts(row.second),
        "rater": row.rater.get_username(),
        "at": row.at.isoformat(),
        **{name: getattr(row, name) for name in ("outcome", "why", "blind")},
    }


def kept_judgement(line: Mapping[str, Any], number: int) -> KeptRating | KeptPreference | None:
    """The line, the `number`th whole one; None where it is neither. EvaError says what is wrong."""
    models: dict[object, type[KeptRating] | type[KeptPreference]] = {
        "rating": KeptRating,
        "preference": KeptPreference,
    }
    model = models.get(line.get("kind"))
    return read(model, line, f"line {number} of its scores") if model else None


def of_trial(trial: Trial) -> UUID:
    """What the file of a trial is named by."""
    return trial.episode_id or trial.uuid
