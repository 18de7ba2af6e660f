"""The lines of DATA/sessions/<uuid>.jsonl: what happened to a session of collecting."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from evaweb.collect.models import SessionEvent
from evaweb.journal import Journal, Line, Moment, Person, RowPath
from evaweb.stations.models import STATION_NAME

_OPENED = ("station", "dataset", "task", "setup")  # what never changes


class EventLine(Line):
    """One line; the first one, `opened`, has all that never changes as well."""

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
        """Of `opened` and `target` as the session is from then on."""
        without = {"opened": (), "target": _OPENED}.get(row.kind, ("target", *_OPENED))
        return {name: value for name, value in super().written(row).items() if name not in without}


SESSIONS = Journal("sessions", EventLine)
