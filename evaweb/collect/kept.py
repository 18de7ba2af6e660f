"""The lines of DATA/sessions/<uuid>.jsonl: written before the row, and read back where the row is lost."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal
from uuid import UUID

from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, ValidationError

from evaweb.collect.models import SessionEvent, SessionEventKind
from evaweb.episodes.folders import data_dir
from evaweb.errors import EvaError
from evaweb.journal import read_lines

_Count = Annotated[int, Field(ge=1, lt=2**31)]


def session_file(uuid: UUID) -> Path:
    """What happened to a session, a line each."""
    return data_dir() / "sessions" / f"{uuid}.jsonl"


class KeptEvent(BaseModel):
    """One line; the first one, `opened`, has all that never changes as well."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    kind: Literal["opened", "closed", "resumed", "target", "published"]
    by: Annotated[str, Field(min_length=1, max_length=150)]
    at: AwareDatetime
    text: str = ""
    target: _Count | None = None
    station: str = ""
    dataset: str = ""
    task: str = ""
    setup: dict[str, Any] = Field(default_factory=dict)


def event_line(event: SessionEvent) -> dict[str, Any]:
    """The line of an event that is about to be saved; of `opened` and `target` as the session is from then on."""
    session = event.session
    line: dict[str, Any] = {
        "kind": str(event.kind),
        "by": event.by.get_username(),
        "at": event.at.isoformat(),
        "text": event.text,
    }
    if event.kind in (SessionEventKind.OPENED, SessionEventKind.TARGET):
        line["target"] = session.target
    if event.kind == SessionEventKind.OPENED:
        line |= {
            "station": session.station.name,
            "dataset": session.dataset,
            "task": session.task,
            "setup": session.setup,
        }
    return line


def kept_events(uuid: UUID) -> list[KeptEvent]:
    """What the file of a session says, oldest first; a torn line never counted. EvaError names one that is wrong."""
    found = []
    for number, line in enumerate(read_lines(session_file(uuid)).lines, start=1):
        try:
            found.append(KeptEvent.model_validate(line))
        except ValidationError as error:
            first = error.errors()[0]
            place = ".".join(map(str, first["loc"]))
            raise EvaError(
                f"line {number} of session {uuid}: {place} is {first['input']!r:.80}: {first['msg']}"
            ) from None
    return found


def opening(events: list[KeptEvent]) -> KeptEvent | None:
    """The line that says all of the session."""
    return next((event for event in events if event.kind == "opened"), None)
