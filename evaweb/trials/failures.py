"""Taxonomy of failures: choices of a form, and validation of scores."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from evaweb.core.errors import EvaError
from evaweb.records.journal import clean_text
from evaweb.trials.failure_text import is_unspecified
from evaweb.trials.models import FailureTerm, Scene, Score
from evaweb.trials.scoring import LONGEST_FAILURE
from runtime.core.sentences import Pattern

_ALLOWED_OTHER_WORDS_NONE_WHERE = Pattern(
    "trials.failures.allowed_other_words_none_where",
    "{field} = {words!r}; allowed: other words, or none if it is not specified",
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
"""Name of each level in scores, forms and REST."""


@dataclass(frozen=True, slots=True)
class Choice:
    """Term of one level with its shortcut key, and whether it is currently selected."""

    words: str
    key: str
    is_selected: bool


@dataclass(frozen=True, slots=True)
class Level:
    """Level of the taxonomy as a form shows it, with the name of its field."""

    field: str
    label: str
    choices: tuple[Choice, ...]

    @property
    def said(self) -> bool:
        """Whether a choice is selected."""
        return any(choice.is_selected for choice in self.choices)


def failure_choices(said: Mapping[str, str] | None = None) -> tuple[Level, ...]:
    """Return the active phases, then the active causes, as a form offers them.

    `said` maps each field to the selected term, which is included even if it is retired or deleted. If there are no
    phases, or no causes, they are omitted.
    """
    terms, levels = list(FailureTerm.objects.filter(active=True)), []
    for field, level in FIELDS.items():
        before = (said or {}).get(field, "")
        choices = [Choice(row.words, row.key, row.words == before) for row in terms if row.level == level]
        if before and not any(choice.is_selected for choice in choices):
            choices.append(Choice(before, "", True))
        if choices:
            levels.append(Level(field, level.label.capitalize(), tuple(choices)))
    return tuple(levels)


def score_failure(score: Score | None) -> dict[str, str]:
    """Return the phase and the cause of the failure in a score as {field: text}; {} without a score."""
    return {field: getattr(score, field) for field in FIELDS} if score else {}


def ordered_terms() -> Mapping[str, tuple[str, ...]]:
    """Return the terms of each level of failures, including retired terms, in the lab's order.

    The keys are the names that the levels have in scores, forms and REST.
    """
    rows = FailureTerm.objects.values_list("level", "words")
    return {field: tuple(text for of, text in rows if of == level) for field, level in FIELDS.items()}


def clean_failure(*, failure_phase: str, failure: str) -> dict[str, str]:
    """Return phase and cause in the form in which they are stored. Raises: EvaError if they cannot be stored."""
    texts = {
        "failure": clean_text("failure", failure, LONGEST_FAILURE),
        "failure_phase": clean_text("failure_phase", failure_phase, LONGEST_FAILURE),
    }
    for field, text in texts.items():
        if is_unspecified(text):
            raise EvaError(_ALLOWED_OTHER_WORDS_NONE_WHERE(field=field, words=text))
    return texts


def check_failure(
    scene: Scene,
    words: Mapping[str, str],
    *,
    success: bool,
    by_person: bool = True,
    said: Mapping[str, str] | None = None,
) -> None:
    """Raise EvaError if a score must not have these `words` (failure phase and cause, by field).

    A success must have neither. A phase must be a term of the lab. A cause must be a term of the lab if a phase is
    given with it, or if the scene requires both from human raters; a cause alone may be any text, because programs send
    such texts. `said` are the words of the previous score, which are also accepted if they are no terms any more.
    """
    for field in FIELDS if success else ():
        if words[field]:
            raise EvaError(_BUT_TRIAL_SUCCESS_LEAVE_EMPTY(field=field, words=words[field]))
    required = scene.failure_required and by_person and not success
    if not (required or any(words[field] for field in FIELDS)):
        return
    offers = {level.field: [choice.words for choice in level.choices] for level in failure_choices(said)}
    for field in FIELDS:
        value, allowed = words[field], offers.get(field, [])
        if required and allowed and not value:
            raise EvaError(
                _MISSING_SCENE_WANTS_EVERY_FAILED(field=field, name=scene.name, allowed=", ".join(allowed))
            )
        listed = required or field == "failure_phase" or words["failure_phase"]
        if listed and value and value not in allowed:
            raise EvaError(f"{field} = {value!r}; allowed: {', '.join(allowed) or 'none, the lab has none'}")
