"""Queries on scenes, checkpoints, evaluations, trials and their scores."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, time, timedelta
from typing import TypeVar

from django.db.models import Count, Model, Prefetch, Q, QuerySet, TextField
from django.db.models.functions import Cast
from django.utils import timezone
from django.utils.dateparse import parse_date, parse_datetime

from evaweb.blinding.visibility import FULL_VISIBILITY, Visibility
from evaweb.core.errors import EvaError, NotFound
from evaweb.core.fingerprint_cache import FingerprintCache
from evaweb.stations.models import Command, Station
from evaweb.statistics.proportions import Summary, summary
from evaweb.trials import lifecycle
from evaweb.trials.models import (
    Checkpoint,
    Evaluation,
    Position,
    Scene,
    Score,
    Trial,
    TrialStatus,
    VoidRequest,
)
from runtime.core.sentences import Pattern

_POSITION_SCENE_DOES_NOT_EXIST = Pattern(
    "trials.selectors.position_scene_does_not_exist",
    "position {number} of scene {name} does not exist; there are: {known}",
)
_DOES_NOT_EXIST_THERE = Pattern(
    "trials.selectors.does_not_exist_there",
    "{kind} {name!r:.80} does not exist; there are: {known}",
)
_TRIAL_DOES_NOT_EXIST = Pattern("trials.selectors.trial_does_not_exist", "trial {identity} does not exist")
_STATUS_ALLOWED = Pattern("trials.selectors.status_allowed", "status = {given!r:.80}; allowed: {values}")
_SINCE_ALLOWED_DAY_SUCH_AS = Pattern(
    "trials.selectors.since_allowed_day_such_as",
    "since = {given!r:.80}; allowed: a day such as 2026-01-31, or a time such as 2026-01-31T08:00:00Z",
)
_SINCE_THERE_NO_SUCH_TIME = Pattern(
    "trials.selectors.since_there_no_such_time",
    "since = {given!r:.80}: there is no such time in UTC",
)

UNFINISHED = (*lifecycle.OPEN_STATES, TrialStatus.ENDED)
_Named = TypeVar("_Named", bound=Model)


# --- by name -----------------------------------------------------------------------------------------------


def scene_get(*, name: str | int) -> Scene:
    """Return the scene of that name or id. Raises: NotFound, which lists the existing ones."""
    return _by_name(Scene.objects.all(), "scene", name)


def checkpoint_get(*, name: str | int, sight: Visibility = FULL_VISIBILITY) -> Checkpoint:
    """Return the checkpoint of that name or id.

    Raises: NotFound if it does not exist or is hidden from the user; the message lists the visible checkpoints.
    """
    return _by_name(_checkpoints(sight), "checkpoint", name)


def evaluation_get(*, name: str | int) -> Evaluation:
    """Return the newest version of the evaluation of that name, or the one with that id."""
    return _by_name(Evaluation.objects.order_by("-version"), "evaluation", name)


def position_get(*, scene: Scene, number: int) -> Position:
    """Return the position of that number. Raises: NotFound, which lists those of the scene."""
    row = scene.positions.filter(number=number).first()
    if row is None:
        numbers = ", ".join(map(str, scene.positions.values_list("number", flat=True))) or "none yet"
        raise NotFound(_POSITION_SCENE_DOES_NOT_EXIST(number=number, name=scene.name, known=numbers))
    return row


def _by_name(rows: QuerySet[_Named], kind: str, name: str | int) -> _Named:
    row = rows.filter(name=str(name)).first()
    if row is None and re.fullmatch(r"[0-9]{1,18}", str(name)):
        row = rows.filter(pk=int(name)).first()
    if row is None:
        names = ", ".join(dict.fromkeys(rows.values_list("name", flat=True))) or "none yet"
        raise NotFound(_DOES_NOT_EXIST_THERE(kind=kind, name=str(name), known=names))
    return row


# --- lists -------------------------------------------------------------------------------------------------


def scene_list(*, all_of_them: bool = False) -> QuerySet[Scene]:
    """Return scenes with positions and milestones: the active ones, or all."""
    rows = Scene.objects.prefetch_related("positions", "milestones")
    return rows if all_of_them else rows.filter(active=True)


def checkpoint_used(checkpoint: Checkpoint) -> bool:
    """Return True if trials or a frozen plan use the checkpoint.

    A frozen plan counts even before its first trial, so that the answer is the same for all its checkpoints.
    """
    return bool(checkpoint.trials.exists() or checkpoint.plan_set.exclude(state="draft").exists())


def checkpoint_list(
    *, all_of_them: bool = False, tag: str = "", sight: Visibility = FULL_VISIBILITY
) -> QuerySet[Checkpoint]:
    """Return the visible checkpoints: the active ones or all, optionally only those with `tag`."""
    rows = _checkpoints(sight)
    if tag:  # match it with its quotes, which tags cannot contain: not every database can query JSON lists
        rows = rows.annotate(written=Cast("tags", TextField())).filter(written__contains=f'"{tag}"')
    return rows if all_of_them else rows.filter(active=True)


def _checkpoints(visibility: Visibility) -> QuerySet[Checkpoint]:
    """Return the visible checkpoints, each without a hidden parent."""
    rows: QuerySet[Checkpoint] = visibility.filter_visible(Checkpoint.objects.all(), "pk")
    return rows.prefetch_related(
        "training_set", Prefetch("parent", queryset=visibility.filter_visible(Checkpoint.objects.all(), "pk"))
    )


def evaluation_list() -> QuerySet[Evaluation]:
    """Return all evaluations by name and version."""
    return Evaluation.objects.select_related("station")


def trial_open(station: Station, worker: str | None = None) -> Trial | None:
    """Return the unfinished trial of the station, or of its copy `worker`.

    Unfinished trials are prepared, running or paused, and at the station itself also those that ended and are not
    scored: at copies, some are scored later, in the order of the schedule.
    """
    states = UNFINISHED if worker is None else lifecycle.OPEN_STATES
    unfinished = Trial.objects.filter(station=station, worker=worker, status__in=states).order_by("-pk")
    return unfinished.select_related(*_NAMED).first()


def trial_get(*, id: int) -> Trial:
    """Return the trial with its related rows. Raises: NotFound."""
    scores = Score.objects.select_related("rater").prefetch_related("outcomes").order_by("-pk")
    rows = Trial.objects.select_related(*_NAMED, "episode", "voided_by")
    requests = VoidRequest.objects.select_related("by", "answered_by")
    trial = (
        rows.prefetch_related(Prefetch("scores", scores), Prefetch("void_requests", requests))
        .filter(pk=id)
        .first()
        if 0 < id < 2**63
        else None
    )
    if trial is None:
        raise NotFound(_TRIAL_DOES_NOT_EXIST(identity=id))
    return trial


# `handout` is a reverse relation defined by evaweb.plans.
_NAMED = ("evaluation", "checkpoint", "scene", "position", "station", "operator", "verdict", "handout")


@dataclass(frozen=True, slots=True)
class TrialFilters:
    """Selection of trials.

    Each field is the name that a trial must have there; "" matches any. `since` selects trials that were prepared at or
    after this time: a day, or a time in ISO 8601.
    """

    evaluation: str = ""
    checkpoint: str = ""
    scene: str = ""
    station: str = ""
    status: str = ""
    since: str = ""

    def apply(self, trials: QuerySet[Trial], sight: Visibility = FULL_VISIBILITY) -> QuerySet[Trial]:
        """Return the matching trials. Raises: NotFound or EvaError, which names the allowed values.

        A hidden checkpoint is treated as unknown: filtering by it would reveal its trials.
        """
        if self.evaluation:
            trials = trials.filter(evaluation=evaluation_get(name=self.evaluation))
        if self.checkpoint:
            trials = trials.filter(checkpoint=checkpoint_get(name=self.checkpoint, sight=sight))
        if self.scene:
            trials = trials.filter(scene=scene_get(name=self.scene))
        if self.station:
            trials = trials.filter(station=_by_name(Station.objects.all(), "station", self.station))
        if self.status:
            trials = trials.filter(status=_status(self.status))
        if self.since:
            trials = trials.filter(prepared_at__gte=_since(self.since))
        return trials


def trial_list(filters: TrialFilters | None = None, sight: Visibility = FULL_VISIBILITY) -> QuerySet[Trial]:
    """Return the matching trials, newest first, with the related rows that lists of trials name."""
    rows = Trial.objects.select_related(*_NAMED, "verdict__rater").order_by("-prepared_at", "-pk")
    return (filters or TrialFilters()).apply(rows, sight)


def trials_in_pages(
    filters: TrialFilters, *, sight: Visibility = FULL_VISIBILITY, size: int = 1000
) -> Iterator[list[Trial]]:
    """Yield all matching trials, oldest first, in lists of at most `size`: for exports of any length."""
    rows = trial_list(filters, sight).order_by("pk").prefetch_related("verdict__outcomes")
    last = 0
    while page := list(rows.filter(pk__gt=last)[:size]):
        yield page
        last = page[-1].pk


def attempts_of(*, trial: Trial) -> QuerySet[Trial]:
    """Return all attempts of the trial's number in order, including itself."""
    key = {
        name: getattr(trial, name)
        for name in ("evaluation_id", "checkpoint_id", "scene_id", "position_id", "number")
    }
    same = Trial.objects.filter(**key, evaluation_version=trial.evaluation_version)
    return same.order_by("attempt")


def commands_of(*, trial: Trial) -> QuerySet[Command]:
    """Return the commands sent to the trial's station between its preparation and its end, oldest first."""
    until = trial.ended_at or (None if trial.status in UNFINISHED else trial.changed_at)
    commands = Command.objects.filter(station=trial.station, issued_at__gte=trial.prepared_at)
    commands = commands.filter(issued_at__lte=until) if until else commands
    mine = Q(pk__in=[key for key in (trial.setup, trial.run) if key])
    return (commands | Command.objects.filter(mine)).select_related("user").order_by("issued_at").distinct()


# --- statistics --------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class StatisticsRow:
    """One checkpoint at one scene: summary of its scored trials, and the numbers of other trials."""

    scene: Scene
    checkpoint: Checkpoint
    summary: Summary
    to_score: int
    interrupted: int
    voided: int


def statistics(
    filters: TrialFilters | None = None, sight: Visibility = FULL_VISIBILITY
) -> list[StatisticsRow]:
    """Return a row per scene and checkpoint, sorted by both names; only scored trials enter the summary.

    Trials of hidden checkpoints are omitted.
    """
    which = filters or TrialFilters()
    trials = which.apply(sight.filter_visible(Trial.objects.order_by()), sight)
    cells = _cells(trials)
    other_counts = _other_counts(trials)
    keys = {*cells, *other_counts}
    scenes = Scene.objects.in_bulk({scene for scene, _ in keys})
    checkpoints = Checkpoint.objects.in_bulk({checkpoint for _, checkpoint in keys})
    rows = [
        StatisticsRow(
            scenes[scene],
            checkpoints[checkpoint],
            cells.get((scene, checkpoint)) or _summary([]),
            other_counts[scene, checkpoint][TrialStatus.ENDED],
            other_counts[scene, checkpoint][TrialStatus.INTERRUPTED],
            other_counts[scene, checkpoint][TrialStatus.VOIDED],
        )
        for scene, checkpoint in keys
    ]
    return sorted(rows, key=lambda row: (row.scene.title, row.scene.pk, row.checkpoint.name))


_Cell = tuple[int, int]  # scene, checkpoint
_Row = tuple[int, datetime, int, int]  # trial, its last change, scene, checkpoint
_Outcome = tuple[bool, float, float | None, float | None]  # success, score, seconds, smoothness
_LATE = timedelta(minutes=10)  # longest delay until a change is visible: clock differences, long transactions
_MOST_CHANGED = 2000  # number of changes beyond which all cells are recomputed


@dataclass(frozen=True, slots=True)
class _Known:
    """Cached summaries by cell, and the newest changes of trials that these summaries already include."""

    cells: dict[_Cell, Summary]
    newest: datetime | None
    recent: frozenset[_Row]


_known: FingerprintCache[_Known] = FingerprintCache()


def _cells(trials: QuerySet[Trial]) -> dict[_Cell, Summary]:
    """Return the summaries of the scored trials among `trials`, by scene and checkpoint.

    `trials` may be filtered by columns of trials only, because cached summaries are updated from changed rows of
    trials: every change to data in a summary also saves its trial or marks the trial as changed. The cache key is the
    query with the ids of named rows, because a name may come to denote another row.
    """
    return _known.renew(str(trials.query), lambda before: _brought_up(before, trials)).cells


def _brought_up(before: _Known | None, trials: QuerySet[Trial]) -> _Known:
    """Return the summaries with the changes since `before`.

    Only the cells with trials that have changed are recomputed.
    """
    since = before.newest - _LATE if before and before.newest else None
    rows = Trial.objects.order_by("-changed_at", "-pk")
    named = rows.values_list("pk", "changed_at", "scene_id", "checkpoint_id")
    # Read before the cells, so that concurrent changes are found the next time.
    changed_rows = list(
        (named if since is None else named.filter(changed_at__gte=since))[: _MOST_CHANGED + 1]
    )
    newest = changed_rows[0][1] if changed_rows else None
    recent = frozenset(row for row in changed_rows if newest and row[1] >= newest - _LATE)
    if (
        before is None
        or since is None
        or len(changed_rows) > _MOST_CHANGED
        or not _same(before.recent, changed_rows)
    ):
        cells = _summarised(trials)
    else:
        changed = {(scene, checkpoint) for _, _, scene, checkpoint in set(changed_rows) - before.recent}
        cells = {cell: summary for cell, summary in before.cells.items() if cell not in changed}
        for scene, checkpoint in changed:
            cells |= _summarised(trials.filter(scene=scene, checkpoint=checkpoint))
    return _Known(cells, newest, recent)


def _same(before: Collection[_Row], rows: Collection[_Row]) -> bool:
    """Return True if all trials in `before` are still in `rows`, with the same scene and checkpoint.

    If not, the database was lost or its clock was set back, and cached summaries cannot be updated.
    """
    return {(pk, scene, checkpoint) for pk, _, scene, checkpoint in before} <= {
        (pk, scene, checkpoint) for pk, _, scene, checkpoint in rows
    }


def _summarised(trials: QuerySet[Trial]) -> dict[_Cell, Summary]:
    return {cell: _summary(outcomes) for cell, outcomes in _scored_cells(trials).items()}


def _scored_cells(trials: QuerySet[Trial]) -> dict[_Cell, list[_Outcome]]:
    cells: dict[_Cell, list[_Outcome]] = defaultdict(list)
    scored = trials.filter(status=TrialStatus.SCORED)
    named = ("verdict__success", "verdict__score", "duration_s", "episode__smoothness")
    for scene, checkpoint, *outcome in scored.values_list("scene_id", "checkpoint_id", *named):
        cells[scene, checkpoint].append((outcome[0], outcome[1], outcome[2], outcome[3]))
    return cells


def _other_counts(trials: QuerySet[Trial]) -> dict[_Cell, dict[str, int]]:
    counted = (TrialStatus.ENDED, TrialStatus.INTERRUPTED, TrialStatus.VOIDED)
    counts: dict[_Cell, dict[str, int]] = defaultdict(lambda: dict.fromkeys(counted, 0))
    grouped = trials.filter(status__in=counted).values("scene_id", "checkpoint_id", "status")
    for row in grouped.annotate(n=Count("pk")):
        counts[row["scene_id"], row["checkpoint_id"]][row["status"]] = row["n"]
    return counts


def _summary(outcomes: Sequence[_Outcome]) -> Summary:
    return summary(
        [success for success, *_ in outcomes],
        [score for _, score, *_ in outcomes],
        [seconds for _, _, seconds, _ in outcomes if seconds is not None],
        [smooth for *_, smooth in outcomes if smooth is not None],
    )


# --- parsing -----------------------------------------------------------------------------------------------


def _status(text: str) -> str:
    if text not in TrialStatus.values:
        raise EvaError(_STATUS_ALLOWED(given=text, values=", ".join(TrialStatus.values)))
    return text


def _since(text: str) -> datetime:
    try:
        moment = parse_datetime(text)
        day = parse_date(text) if moment is None else None
    except ValueError:  # well-formed, but not a valid date
        moment = day = None
    if day is not None:
        moment = datetime.combine(day, time.min)
    if moment is None:
        raise EvaError(_SINCE_ALLOWED_DAY_SUCH_AS(given=text))
    try:
        moment = moment if timezone.is_aware(moment) else timezone.make_aware(moment)
        return moment.astimezone(UTC)
    except OverflowError:  # at the end of the calendar, where conversion between zones overflows
        raise EvaError(_SINCE_THERE_NO_SUCH_TIME(given=text)) from None
