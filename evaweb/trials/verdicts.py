"""What a rater's ticks come to: pure arithmetic on the milestones of a scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from evaweb.errors import EvaError
from evaweb.trials.models import Milestone

LONGEST_NOTE = 8000  # characters
LONGEST_FAILURE = 60


@dataclass(frozen=True, slots=True)
class Verdict:
    """Which milestones were reached, the share of their points, and whether that is a success."""

    reached: tuple[tuple[Milestone, bool], ...]
    score: float
    success: bool


def verdict(milestones: Sequence[Milestone], ticks: Mapping[object, object], success: bool | None) -> Verdict:
    """The verdict on one trial from `ticks`: milestone id -> reached, one for each of the scene's milestones.

    Success is: all required milestones are reached. Where none is required it has to be given. EvaError says
    which ids are missing or not the scene's, and what contradicts itself.
    """
    answers = _answers(milestones, ticks)
    reached = tuple((milestone, answers[milestone.pk]) for milestone in milestones)
    implied = _implied(reached)
    if implied is None and success is None:
        raise EvaError("success is missing: no milestone of this scene is required, so say true or false")
    if implied is not None and success is not None and success != implied:
        raise EvaError(
            f"success = {success} contradicts the required milestones, which say {implied}: "
            "correct the milestones, or leave success out"
        )
    final = bool(success if implied is None else implied)
    return Verdict(reached, _share(reached, final), final)


def text(name: str, given: str, longest: int) -> str:
    """A text as it was typed, without blanks at its ends; EvaError where it cannot be stored."""
    if "\x00" in given:
        raise EvaError(f"{name} contains the character U+0000, which no database keeps: remove it")
    stripped = given.strip()
    if len(stripped) > longest:
        raise EvaError(f"{name} has {len(stripped)} characters; allowed: at most {longest}")
    return stripped


def _answers(milestones: Sequence[Milestone], ticks: Mapping[object, object]) -> dict[int, bool]:
    known = {milestone.pk: milestone.text for milestone in milestones}
    names = ", ".join(f"{pk} ({words})" for pk, words in known.items()) or "none, the scene has no milestones"
    by_name = {str(pk): pk for pk in known}
    found: dict[int, bool] = {}
    for key, value in ticks.items():
        pk = by_name.get(str(key))
        if pk is None:
            raise EvaError(f"milestone {key!r} is not one of this scene; allowed: {names}")
        if not isinstance(value, bool):
            raise EvaError(f"milestone {key}: {value!r}; allowed: true, false")
        found[pk] = value
    missing = [str(pk) for pk in known if pk not in found]
    if missing:
        raise EvaError(
            f"milestone {', '.join(missing)} is not answered: say true or false for each of {names}"
        )
    return found


def _implied(reached: Sequence[tuple[Milestone, bool]]) -> bool | None:
    required = [done for milestone, done in reached if milestone.required]
    return all(required) if required else None


def _share(reached: Sequence[tuple[Milestone, bool]], success: bool) -> float:
    total = sum(milestone.points for milestone, _ in reached)
    if not total:
        return float(success)
    return sum(milestone.points for milestone, done in reached if done) / total
