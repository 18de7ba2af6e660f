"""Lines of DATA/sessions/<uuid>.jsonl: events of a collection session."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from evaweb.collect.models import SessionEvent
from evaweb.records.journal import (
    Journal,
    Line,
    Moment,
    Person,
    RowPath,
)
from evaweb.stations.models import STATION_NAME

_OPENED = ("station", "dataset", "task", "setup")  # constant values


class EventLine(Line):
    """Event of a session; the first event, `opened`, also has the values that stay constant during the session."""

    ELSEWHERE: ClassVar = frozenset[str]()

    kind: Literal["opened", "closed", "resumed", "target", "published"]
    by: Annotated[Person, RowPath("by__username")]
    at: Moment
    text: str = ""
    target: Annotated[Annotated[int, Field(ge=1, lt=2**31)] | None, RowPath("session__target")] = None
    station: Annotated[str, Field(pattern=STATION_NAME), RowPath("session__station__name")] = ""
    dataset: Annotated[str, RowPath("session__dataset")] = ""
    task: Annotated[str, RowPath("session__task")] = ""
    setup: Annotated[dict[str, Any], RowPath("session__setup")] = Field(default_factory=dict)

    @classmethod
    def written(cls, row: SessionEvent, **given: Any) -> dict[str, Any]:
        """Return the line of an event that is about to be saved.

        The line of an event of kind `opened` has all values of the session. That of kind `target` has the session's
        target only; lines of other kinds have no values of the session.
        """
        without = {"opened": (), "target": _OPENED}.get(row.kind, ("target", *_OPENED))
        return {name: value for name, value in super().written(row).items() if name not in without}


SESSIONS = Journal("sessions", EventLine)
