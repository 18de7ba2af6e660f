"""Records that are only ever added: a line on the disk before the row, from which the row can be made again.

A `Line` declares what a record has: it is written from the row, checked when it is read, and gives back what the row
is made of. A `Journal` is a folder of files of lines, a file for each episode, trial or session.
"""

from __future__ import annotations

import json
import logging
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from enum import Enum
from functools import cache
from io import FileIO
from pathlib import Path
from typing import Annotated, Any, ClassVar, Generic, TypeVar, Union
from uuid import UUID

from django.conf import settings
from django.db.models import Model
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    PlainValidator,
    TypeAdapter,
    ValidationError,
    field_validator,
)

from evaweb.errors import EvaError
from evaweb.roles import get_or_create_person
from runtime.core.sentences import Pattern
from runtime.recording.files import RecordingError

log = logging.getLogger(__name__)
_CONTAINS_CHARACTER_U_0000_WHICH = Pattern(
    "web.journal.contains_character_u_0000_which",
    "{name} contains the character U+0000, which no database keeps: remove it",
)
_HAS_CHARACTERS_ALLOWED_AT_MOST = Pattern(
    "web.journal.has_characters_allowed_at_most",
    "{name} has {count} characters; allowed: at most {longest}",
)
_ITS_IS_OF = Pattern("web.journal.its_is_of", "its {verbose_name} {uuid} is of {belongs} {other}")
_NOT_KEPT = Pattern("web.journal.not_kept", "not kept: {strerror} ({path}); {done}")


class NotWritten(EvaError):
    """The disk did not take it, and so the database was not told either."""

    status = 507


def clean_text(name: str, given: str, longest: int) -> str:
    """A text as it was typed, without blanks at its ends; EvaError where it cannot be stored."""
    if "\x00" in given:
        raise EvaError(_CONTAINS_CHARACTER_U_0000_WHICH(name=name))
    stripped = given.strip()
    if len(stripped) > longest:
        raise EvaError(_HAS_CHARACTERS_ALLOWED_AT_MOST(name=name, count=len(stripped), longest=longest))
    return stripped


# --- one line ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class RowPath:
    """Where a row has what a field of its line says, as queries name it: `rater__username`; "" under its own name."""

    path: str


def _moment(given: Any) -> datetime:
    """A time as `plain` writes it: ISO 8601, with its zone, in years that every zone has."""
    found = datetime.fromisoformat(given) if isinstance(given, str) else None
    if found is None or found.tzinfo is None or not 1900 <= found.year <= 9998:
        raise ValueError("allowed: date and time of ISO 8601 with a time zone, in the years 1900 to 9998")
    return found


def _storable(value: Any) -> Any:
    """The same, which both databases can keep; ValueError."""
    if isinstance(value, str) and "\x00" in value:
        raise ValueError("it contains the character U+0000, which no database keeps")
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError("it contains a number that is not finite")
    inner = (*value, *value.values()) if isinstance(value, dict) else value
    for each in inner if isinstance(inner, list | tuple) else ():
        _storable(each)
    return value


Person = Annotated[str, Field(min_length=1, max_length=150)]
Moment = Annotated[datetime, PlainValidator(_moment)]


class Line(BaseModel):
    """A record in plain JSON, as this program wrote it. What came later has a default; what is unknown is left."""

    model_config = ConfigDict(frozen=True, extra="ignore", strict=True)
    ELSEWHERE: ClassVar[frozenset[str]] = frozenset({"kind"})  # what is in no column of the row

    @field_validator("*")
    @classmethod
    def _kept(cls, value: Any) -> Any:
        return _storable(value)

    @classmethod
    def path_of(cls, name: str) -> str:
        """Where the row has it."""
        found = (each.path for each in cls.model_fields[name].metadata if isinstance(each, RowPath))
        return next(found, "") or name

    @classmethod
    def names(cls) -> Iterable[str]:
        """What is written, in this order."""
        return cls.model_fields

    @classmethod
    def written(cls, row: Any, **given: Any) -> dict[str, Any]:
        """The line of a row that is about to be saved; `given` is what the row does not say."""
        return {
            name: given[name] if name in given else to_json_value(cls._value(row, name))
            for name in cls.names()
        }

    @classmethod
    def _value(cls, row: Any, name: str) -> Any:
        field = cls.model_fields[name]
        if name in cls.ELSEWHERE:
            return field.default
        value = resolve_path(row, cls.path_of(name))
        nested = field.annotation
        return (
            nested.written(value)
            if isinstance(nested, type) and issubclass(nested, Line) and value
            else value
        )

    def to_row_values(self) -> dict[str, Any]:
        """What the row is made of: people as their accounts; what lies in other rows is left out."""
        found = {}
        for name in type(self).names():
            field, _, further = type(self).path_of(name).partition("__")
            value = getattr(self, name)
            if further == "username":
                found[field] = get_or_create_person(value)
            elif not further and name not in self.ELSEWHERE and not isinstance(value, Line):
                found[field] = value
        return found


def resolve_path(row: Any, path: str) -> Any:
    """What a path of a query leads to; None where it ends before."""
    for name in path.split("__"):
        row = getattr(row, name, None) if row is not None else None
    return row


def to_json_value(value: Any) -> Any:
    """A value as JSON has it."""
    if isinstance(value, datetime):
        return value.isoformat()
    if isinstance(value, Enum):
        return value.value
    return str(value) if isinstance(value, UUID) else value


AnyLine = TypeVar("AnyLine", bound=Line)


def missing_rows(model: type[Model], lines: Sequence[AnyLine], **owner: Model) -> list[AnyLine]:
    """The lines whose rows are not there, of one that was given twice the last; EvaError for one of another owner."""
    ((belongs, whose),) = owner.items()
    last = {line.uuid: line for line in lines}  # type: ignore[attr-defined]
    rows = dict(model._default_manager.filter(uuid__in=last).values_list("uuid", belongs))
    for uuid, other in rows.items():
        if other != whose.pk:
            raise EvaError(
                _ITS_IS_OF(verbose_name=model._meta.verbose_name, uuid=uuid, belongs=belongs, other=other)
            )
    return [line for uuid, line in last.items() if uuid not in rows]


# --- the files ---------------------------------------------------------------------------------------------

_kinds: dict[str, tuple[type[Line], ...]] = {}  # of each folder; several journals may write into its files


class Journal(Generic[AnyLine]):
    """DATA/`folder`/<uuid>.jsonl, and the kinds of lines that are written there."""

    def __init__(self, folder: str, *kinds: type[AnyLine]) -> None:
        self.folder = folder
        _kinds[folder] = (*_kinds.get(folder, ()), *kinds)

    def path(self, uuid: UUID) -> Path:
        """The file of one episode, trial or session."""
        return Path(settings.DATA_DIR) / self.folder / f"{uuid}.jsonl"

    def append(self, uuid: UUID, line: Mapping[str, Any]) -> None:
        """Add one line and wait until it is on the disk; the caller holds a row. Raises NotKept."""
        append_line(self.path(uuid), line)

    def read(self, uuid: UUID, say: Callable[[str], None]) -> list[AnyLine]:
        """What the file says, oldest first, also what other journals of the folder have written.

        A line that is not whole, or that is none of theirs, is left out: `say` is told file, line and field.
        """
        path, found, lines = self.path(uuid), [], _reader(_kinds[self.folder])
        for number, line in read_numbered_lines(path):
            try:
                found.append(lines.validate_json(line))
            except ValidationError as error:
                say(f"{path}: line {number} {_wrong(error)}")
        return found


@cache
def _reader(kinds: tuple[type[Line], ...]) -> TypeAdapter[Any]:
    either = Union[kinds]  # noqa: UP007  made of a list
    return TypeAdapter(Annotated[either, Field(discriminator="kind")] if len(kinds) > 1 else either)


def folders() -> list[str]:
    """The folders of all journals."""
    return sorted(_kinds)


def parse_model(model: type[AnyLine], content: Mapping[str, Any], what: str) -> AnyLine:
    """`content` as that model; EvaError says after `what` the first thing that is wrong with it."""
    try:
        return model.model_validate_json(json.dumps(content))
    except ValidationError as error:
        raise EvaError(f"{what} {_wrong(error)}") from None


def _wrong(error: ValidationError) -> str:
    """The first thing that is wrong with a line, after its name."""
    first = error.errors()[0]
    if first["type"] == "json_invalid":
        why, _, _ = first["ctx"]["error"].partition(" at line ")
        return f"is not whole and was left out: {why}"
    place = ".".join(map(str, first["loc"]))
    return f"was left out: {place}{' is ' if place else ''}{first['input']!r:.80}: {first['msg']}"


def append_line(path: Path, line: Mapping[str, Any]) -> None:
    """Add one line and wait until it is on the disk; a line torn by a crash before it stays a line of its own.

    The caller holds a row of the database, so that there is one writer at a time. Raises NotKept, which says whether
    the line was taken back.
    """
    text = json.dumps(line, allow_nan=False, separators=(",", ":"))  # ASCII: no character in it ends a line
    done = "nothing was changed"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab+", buffering=0) as file:
            before = file.seek(0, os.SEEK_END)
            try:
                _written(file, text.encode() + b"\n")
            except OSError:
                done = _truncate_back(file, before)
                raise
    except OSError as error:
        raise NotWritten(_NOT_KEPT(strerror=error.strerror, path=path, done=done)) from error


def _written(file: FileIO, payload: bytes) -> None:
    new = file.tell() == 0
    if not new:
        file.seek(-1, os.SEEK_END)
        payload = payload if file.read(1) == b"\n" else b"\n" + payload
    while payload:
        payload = payload[file.write(payload) :]
    os.fsync(file.fileno())
    if new:
        folder = Path(file.name).parent
        _sync_folder(folder)
        _sync_folder(folder.parent)


def _truncate_back(file: FileIO, before: int) -> str:
    """Give the file the length that it had; what became of the line, in words."""
    try:
        file.truncate(before)
        os.fsync(file.fileno())
    except OSError:
        log.exception("%s could not be made as long as it was", file.name)
        return "what was written could not be taken back: the next reconcile may take it for said"
    return "nothing was changed"


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def read_numbered_lines(path: Path) -> Iterator[tuple[int, bytes]]:
    """The lines of a file with their numbers, from 1; none of an absent one. RecordingError if it is unreadable."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror}") from error
    for number, line in enumerate(data.split(b"\n"), start=1):
        if line.strip():
            yield number, line
