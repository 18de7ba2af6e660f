"""Failed trials grouped by cause, phase, position or checkpoint, with counts and clips."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any
from urllib.parse import urlencode

from django.db.models import (
    BooleanField,
    Case,
    CharField,
    Count,
    F,
    Q,
    QuerySet,
    Value,
    When,
)

from evaweb.blinding.visibility import HIDDEN, Visibility, code_of
from evaweb.core.errors import EvaError
from evaweb.trials.clips import clip_of
from evaweb.trials.failure_text import UNSPECIFIED, is_unspecified
from evaweb.trials.models import Trial, TrialStatus
from evaweb.trials.selectors import TrialFilters, trial_list
from runtime.core.sentences import Pattern

_GROUP_ALLOWED = Pattern("trials.gallery.group_allowed", "group = {group!r:.80}; allowed: {groups}")
_POSITION_ALLOWED_SCENE_NUMBER = Pattern(
    "trials.gallery.position_allowed_scene_number",
    "position = {position!r:.80}; allowed: SCENE/NUMBER",
)

GROUPS = {"failure": "cause", "failure_phase": "phase", "position": "position", "checkpoint": "checkpoint"}
NAMED = ("evaluation", "checkpoint", "scene", "position", "operator", "verdict", "handout")
_WORDS = ("failure", "failure_phase")
COLUMNS = (
    *("trial", "code", "evaluation", "scene", "position", "checkpoint", "operator", "started_at"),
    *("failure_phase", "failure", "missed", "note", "begin_s", "end_s", "clip"),
)


@dataclass(frozen=True, slots=True)
class FailureFilters:
    """Selection of failed trials ("" matches any), and how they are grouped (`group`, one of GROUPS).

    `position` is "SCENE/NUMBER"; phase and cause may be "not specified".
    """

    trials: TrialFilters = field(default_factory=TrialFilters)
    position: str = ""
    failure: str = ""
    failure_phase: str = ""
    group: str = "failure"

    @property
    def narrowed(self) -> bool:
        """Whether any filter is set."""
        return replace(self, group="failure") != FailureFilters()

    @property
    def words(self) -> str:
        """Display name of the grouping."""
        return GROUPS[self.group]

    @property
    def query(self) -> str:
        """Filters as a URL query string."""
        values = {
            **asdict(self.trials),
            **{name: getattr(self, name) for name in ("position", *_WORDS, "group")},
        }
        return urlencode({name: value for name, value in values.items() if value})


@dataclass(frozen=True, slots=True)
class Group:
    """Group of failures: name, number of trials, and URL of the group alone ("" for hidden checkpoints)."""

    name: str
    count: int
    address: str


def failed_list(filters: FailureFilters, sight: Visibility) -> QuerySet[Trial]:
    """Return the failed trials that count, sorted by group, newest first. Raises: EvaError for invalid filters.

    If trials are grouped by checkpoint, those of hidden checkpoints form one group at the end, sorted by trial number,
    so that their checkpoints cannot be distinguished.
    """
    if filters.group not in GROUPS:
        raise EvaError(_GROUP_ALLOWED(group=filters.group, groups=", ".join(GROUPS)))
    rows = trial_list(filters.trials, sight).filter(status=TrialStatus.SCORED, verdict__success=False)
    for name in _WORDS:
        if value := getattr(filters, name):
            rows = rows.filter(**{f"verdict__{name}": "" if is_unspecified(value) else value})
    if filters.position:
        scene, _, number = filters.position.rpartition("/")
        if not (number.isascii() and number.isdecimal() and len(number) < 7):
            raise EvaError(_POSITION_ALLOWED_SCENE_NUMBER(position=filters.position))
        rows = rows.filter(scene__name=scene, position__number=int(number))
    return rows.annotate(**_keys(filters.group, sight)).order_by(*_keys(filters.group, sight), "-pk")


def failure_groups(filters: FailureFilters, sight: Visibility) -> list[Group]:
    """Return the groups, largest first."""
    keys = list(_keys(filters.group, sight))
    rows = failed_list(filters, sight).order_by().values_list(*keys).annotate(n=Count("pk"))
    groups = [Group(_named(filters.group, key), n, _alone(filters, key)) for *key, n in rows]
    return sorted(groups, key=lambda group: (-group.count, group.name))


def failures_of(keys: Sequence[int], filters: FailureFilters, sight: Visibility) -> list[Trial]:
    """Return the trials with these ids, in the order of `failed_list`, with related rows loaded.

    For very many trials a caller can sort the ids alone, and then load the rows in parts with this function.
    """
    rows = failed_list(filters, sight).filter(pk__in=keys).select_related("episode", *NAMED)
    return list(rows.prefetch_related("verdict__outcomes"))


def shown_group(trial: Trial, filters: FailureFilters) -> str:
    """Return the name of the group of a trial from `failed_list`."""
    names = {"position": ("group_scene", "group_number")}.get(filters.group, ("group_last", "group_words"))
    return _named(filters.group, [getattr(trial, name) for name in names])


def failure_rows(
    filters: FailureFilters, sight: Visibility, root: str, size: int = 500
) -> Iterator[list[dict[str, Any]]]:
    """Yield all failures as rows of COLUMNS, in lists of at most `size`, oldest first; `root` prefixes URLs."""
    for page in failure_trials(filters, sight, size):
        yield [row_of(trial, sight, root) for trial in page]


def failure_trials(filters: FailureFilters, sight: Visibility, size: int = 500) -> Iterator[list[Trial]]:
    """Yield all failures with related rows loaded, in lists of at most `size`, oldest first."""
    trials = (
        failed_list(filters, sight).prefetch_related("verdict__outcomes").select_related("episode", *NAMED)
    )
    last = 0
    while page := list(trials.order_by("pk").filter(pk__gt=last)[:size]):
        yield page
        last = page[-1].pk


def row_of(trial: Trial, sight: Visibility, root: str) -> dict[str, Any]:
    """Return one failure as a row of COLUMNS."""
    clip, verdict = clip_of(trial), trial.verdict
    return {
        "trial": trial.pk,
        "code": code_of(trial),
        "evaluation": trial.evaluation.name,
        "scene": trial.scene.name,
        "position": trial.position.number,
        "checkpoint": sight.checkpoint_label(trial),
        "operator": trial.operator.get_username(),
        "started_at": trial.started_at,
        **{name: getattr(verdict, name) for name in (*_WORDS, "note")},
        "missed": clip.missed if clip else "",
        "begin_s": clip.begin if clip else None,
        "end_s": clip.end if clip else None,
        "clip": f"{root}{clip.share}" if clip else "",
    }


def _keys(group: str, visibility: Visibility) -> dict[str, Any]:
    """Return the two expressions by which trials are grouped and sorted; the first puts unnamed groups last."""
    if group == "position":
        return {"group_scene": F("scene__name"), "group_number": F("position__number")}
    if group == "checkpoint":
        hidden = Q(checkpoint__in=visibility.checkpoints)
        return {
            "group_last": _true(hidden),
            "group_words": Case(
                When(hidden, then=Value("")), default=F("checkpoint__name"), output_field=CharField()
            ),
        }
    return {"group_last": _true(Q(**{f"verdict__{group}": ""})), "group_words": F(f"verdict__{group}")}


def _true(condition: Q) -> Case:
    return Case(When(condition, then=Value(True)), default=Value(False), output_field=BooleanField())


def _named(group: str, key: list[Any]) -> str:
    if group == "position":
        return f"{key[0]}/{key[1]}"
    if group == "checkpoint":
        return HIDDEN if key[0] else str(key[1])
    return str(key[1]) or UNSPECIFIED


def _alone(filters: FailureFilters, key: list[Any]) -> str:
    name = _named(filters.group, key)
    if filters.group != "checkpoint":
        only = replace(filters, **{filters.group: name})
    elif key[0]:
        return ""
    else:
        only = replace(filters, trials=replace(filters.trials, checkpoint=name))
    return f"?{only.query}"
