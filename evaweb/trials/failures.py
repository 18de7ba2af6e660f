"""The lab's taxonomy of failures: what a form offers, and what a score may say."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from evaweb.errors import EvaError
from evaweb.journal import clean_text
from evaweb.trials.failure_words import is_not_said
from evaweb.trials.models import FailureTerm, Scene, Score
from evaweb.trials.verdicts import LONGEST_FAILURE
from runtime.core.sentences import Pattern

_ALLOWED_OTHER_WORDS_NONE_WHERE = Pattern(
    "trials.failures.allowed_other_words_none_where",
    "{field} = {words!r}; allowed: other words, or none where nothing is said of it",
)
_BUT_TRIAL_SUCCESS_LEAVE_EMPTY = Pattern(
    "trials.failures.but_trial_success_leave_empty",
    "{field} = {words!r} but the trial is a success: leave {field} empty",
)
_MISSING_SCENE_WANTS_EVERY_FAILED = Pattern(
    "trials.failures.missing_scene_wants_every_failed",
    "{field} is missing: scene {name} wants it of every failed trial; allowed: {allowed}",
)

FIELDS = {"failure_phase": FailureTerm.Level.PHASE, "failure": FailureTerm.Level.CAUSE}
"""What scores, forms and REST call each level."""


@dataclass(frozen=True, slots=True)
class Choice:
    """Words of one level, with their key, and whether they are those that were said before."""

    words: str
    key: str
    is_selected: bool


@dataclass(frozen=True, slots=True)
class Level:
    """One level as a form offers it, under the name of its field."""

    field: str
    label: str
    choices: tuple[Choice, ...]

    @property
    def said(self) -> bool:
        """True if one is chosen."""
        return any(choice.is_selected for choice in self.choices)


def failure_choices(said: Mapping[str, str] | None = None) -> tuple[Level, ...]:
    """Phases, then causes, those that are retired left out; what was `said` before stays, whatever became of it.

    A level without words is left out.
    """
    terms, found = list(FailureTerm.objects.filter(active=True)), []
    for field, level in FIELDS.items():
        before = (said or {}).get(field, "")
        known = [Choice(row.words, row.key, row.words == before) for row in terms if row.level == level]
        if before and not any(choice.is_selected for choice in known):
            known.append(Choice(before, "", True))
        if known:
            found.append(Level(field, level.label.capitalize(), tuple(known)))
    return tuple(found)


def score_failure(score: Score | None) -> dict[str, str]:
    """What a score says of it, by field."""
    return {field: getattr(score, field) for field in FIELDS} if score else {}


def ordered_terms() -> Mapping[str, tuple[str, ...]]:
    """Of each level by its field the words, retired ones too, in the lab's order."""
    rows = FailureTerm.objects.values_list("level", "words")
    return {field: tuple(words for of, words in rows if of == level) for field, level in FIELDS.items()}


def clean_failure(*, failure_phase: str, failure: str) -> dict[str, str]:
    """Both as they are kept; EvaError where they cannot be."""
    found = {
        "failure": clean_text("failure", failure, LONGEST_FAILURE),
        "failure_phase": clean_text("failure_phase", failure_phase, LONGEST_FAILURE),
    }
    for field, words in found.items():
        if is_not_said(words):
            raise EvaError(_ALLOWED_OTHER_WORDS_NONE_WHERE(field=field, words=words))
    return found


def check_failure(
    scene: Scene,
    words: Mapping[str, str],
    *,
    success: bool,
    by_person: bool = True,
    said: Mapping[str, str] | None = None,
) -> None:
    """EvaError where a score must not say `words`, by field; `said` is what stood before, which may stay.

    A phase is one of the lab's. So is a cause that stands with a phase, or where the scene wants both of whoever
    scores; a cause alone may be in other words, as programs have them.
    """
    for field in FIELDS if success else ():
        if words[field]:
            raise EvaError(_BUT_TRIAL_SUCCESS_LEAVE_EMPTY(field=field, words=words[field]))
    wanted = scene.failure_required and by_person and not success
    if not (wanted or any(words[field] for field in FIELDS)):
        return
    offers = {level.field: [choice.words for choice in level.choices] for level in failure_choices(said)}
    for field in FIELDS:
        value, allowed = words[field], offers.get(field, [])
        if wanted and allowed and not value:
            raise EvaError(
                _MISSING_SCENE_WANTS_EVERY_FAILED(field=field, name=scene.name, allowed=", ".join(allowed))
            )
        listed = wanted or field == "failure_phase" or words["failure_phase"]
        if listed and value and value not in allowed:
            raise EvaError(f"{field} = {value!r}; allowed: {', '.join(allowed) or 'none, the lab has none'}")
