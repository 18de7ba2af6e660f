"""Columns and filters of the list of datasets, and of the episodes of one dataset."""

from __future__ import annotations

from collections.abc import Sequence

from evaweb.datasets.episode_list import RESULTS, VERDICTS
from evaweb.datasets.overview import Overview
from evaweb.serving.lists import (
    SEARCH,
    Column,
    Filter,
    words_of,
)

COLUMNS = (
    Column("dataset", "Dataset", ("short",), lambda row: row.short),
    Column("version", "Version", ("version",), lambda row: row.version),
    Column("robot", "Robot", ("robot",), lambda row: row.robot),
    Column("episodes", "Episodes", ("episodes",), lambda row: row.episodes, number=True),
    Column("rows", "Rows", ("frames",), lambda row: row.frames, number=True),
    Column("rate", "Rate [Hz]", cell=lambda row: row.fps, hidden=True),
    Column("time", "Time", ("seconds",), lambda row: row.seconds, number=True),
    Column("cameras", "Cameras", cell=lambda row: " ".join(row.cameras)),
    Column("size", "Size", ("size",), lambda row: row.size, number=True),
    Column("problem", "Problem", cell=lambda row: row.problem, hidden=True),
    Column("check", "Check"),
)


def filters(found: Sequence[Overview]) -> list[Filter]:
    """Return the filters of the list of datasets."""
    robots, versions = ({getattr(row, name) for row in found} - {""} for name in ("robot", "version"))
    return [
        Filter("words", "Words", kind=SEARCH, hint="of its name"),
        Filter("robot", "Robot", [(name, name) for name in sorted(robots)]),
        Filter("version", "Version", [(name, name) for name in sorted(versions)]),
    ]


def fits(one: Overview, *, words: str, robot: str, version: str) -> bool:
    """Return True if the dataset matches the filters; "" matches all."""
    return (
        all(word in one.name.casefold() for word in words_of(words.casefold()))
        and robot in ("", one.robot)
        and version in ("", one.version)
    )


EPISODE_COLUMNS = (
    Column("index", "Index", ("index",), lambda row: row.index, number=True),
    Column("task", "Task", ("task", "index"), lambda row: row.task),
    Column("result", "Result", ("result", "index"), lambda row: row.result),
    Column("recording", "Recording", ("uuid",), lambda row: row.uuid),
    Column("review", "Review", ("verdict", "index"), lambda row: row.verdict),
    Column("rows", "Rows", ("length", "index"), lambda row: row.length, number=True),
    Column("time", "Time [s]", cell=lambda row: row.seconds, hidden=True),
    Column("lasts", "Time", ("seconds", "index"), number=True),
)
EPISODE_FILTERS = (
    Filter("words", "Words", kind=SEARCH, hint="task, uuid, station"),
    Filter("result", "Result", tuple((one, one) for one in RESULTS)),
    Filter("verdict", "Review", tuple((one, one) for one in VERDICTS)),
)
