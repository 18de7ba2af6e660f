"""Columns and filters of the list of episodes that a user may see."""

from __future__ import annotations

from typing import Any

from evaweb.blinding.visibility import Visibility
from evaweb.episodes.models import Episode, EpisodeMode, EpisodeStatus
from evaweb.episodes.selectors import QUALITY, REVIEW, tag_counts
from evaweb.episodes.subsets import subset_list
from evaweb.serving.lists import SEARCH, Column, Filter
from evaweb.stations.models import Station


def filters(sight: Visibility) -> list[Filter]:
    """Return the filters. There is no filter for checkpoints: the word search finds their names."""
    stations = [(station.name, str(station)) for station in Station.objects.all()]
    return [
        Filter("words", "Words", kind=SEARCH, hint="task, scene, checkpoint, operator, code"),
        Filter("station", "Station", stations),
        Filter("mode", "Mode", EpisodeMode.choices),
        Filter("status", "Recording", EpisodeStatus.choices),
        Filter("quality", "Quality", [(key, label) for key, (label, _) in QUALITY.items()]),
        Filter("review", "Review", [(key, label) for key, (label, _) in REVIEW.items()]),
        Filter("tag", "Tag", [(label, label) for label in tag_counts(sight=sight)]),
        Filter("subset", "Subset", [(row.name, row.name) for row in subset_list(sight=sight)]),
    ]


def columns(sight: Visibility) -> list[Column]:
    """Return the columns of the list of episodes.

    Sorting by checkpoint is offered only if no checkpoint is hidden, because the order would reveal it.
    """
    checkpoint = ("trial__checkpoint__name", "checkpoint") if sight.hides_nothing else ()
    return [
        Column("picture", "Picture", quiet=True),
        Column("recorded", "Recorded", ("started_at",), lambda row: row.started_at, down=True),
        Column("task", "Scene or task", ("trial__scene__title", "trial__position__number", "task"), _task),
        Column("checkpoint", "Checkpoint", checkpoint, sight.policy_of),
        Column("mode", "Mode", ("mode",), lambda row: row.mode),
        Column("station", "Station", ("station__name",), lambda row: row.station.name),
        Column("result", "Result", ("trial__verdict__success", "demonstration__result"), _result),
        Column("time", "Time", ("duration_s",), lambda row: row.duration_s, number=True),
        Column("recording", "Recording and review", ("status",), lambda row: row.status),
        Column("dataset", "Dataset", ("dataset", "dataset_index"), lambda row: row.dataset),
        Column("index", "Index in the dataset", cell=lambda row: row.dataset_index, hidden=True),
        Column("review", "Review", cell=_review, hidden=True),
        Column("tags", "Tags", cell=lambda row: ", ".join(sight.tags_of(row)), hidden=True),
        Column("operator", "Operator", cell=lambda row: row.operator, hidden=True),
        Column("uuid", "UUID", cell=lambda row: row.uuid, hidden=True),
    ]


def _task(row: Episode) -> str:
    trial: Any = getattr(row, "trial", None)
    return f"{trial.scene.title}, position {trial.position.number}" if trial else row.task


def _result(row: Episode) -> str:
    trial: Any = getattr(row, "trial", None)
    if trial is not None and trial.status != "scored":
        return str(trial.status)
    if trial is not None:
        return "success" if trial.verdict.success else "failure"
    return str(getattr(getattr(row, "demonstration", None), "result", ""))


def _review(row: Episode) -> str:
    review = getattr(getattr(row, "standing", None), "review", None)
    return str(review.verdict) if review else ""
