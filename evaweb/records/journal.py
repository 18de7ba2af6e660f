"""Append-only files with one line per record, written before the database row, from which the row can be restored.

A `Line` declares the fields of a record: it is written from a row, validated when read, and converted back to the
values of a row. A `Journal` is a folder with one file of lines per episode, trial or session.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from enum import Enum
from functools import cache
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

from evaweb.accounts.roles import get_or_create_person
from evaweb.core.errors import EvaError
from runtime.core.durable_files import AppendError, append_durably
from runtime.core.sentences import Pattern
from runtime.recording.files import RecordingError

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
    """Error if the disk refused the line; the database was not changed either."""

    status = 507


def clean_text(name: str, given: str, longest: int) -> str:
    """Return typed text without surrounding blanks. Raises: EvaError if it is too long or contains NUL."""
    if "\x00" in given:
        raise EvaError(_CONTAINS_CHARACTER_U_0000_WHICH(name=name))
    stripped = given.strip()
    if len(stripped) > longest:
        raise EvaError(_HAS_CHARACTERS_ALLOWED_AT_MOST(name=name, count=len(stripped), longest=longest))
    return stripped


# --- one line ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class RowPath:
    """Annotation of a line's field: the query path to the attribute of the row that has the field's value.

    An example is `rater__username`. "" stands for the field's own name.
    """

    path: str


def _moment(value: Any) -> datetime:
    """Parse a time in ISO 8601 with a zone, in years that every time zone can represent."""
    moment = datetime.fromisoformat(value) if isinstance(value, str) else None
    if moment is None or moment.tzinfo is None or not 1900 <= moment.year <= 9998:
        raise ValueError("allowed: date and time of ISO 8601 with a time zone, in the years 1900 to 9998")
    return moment


def _storable(value: Any) -> Any:
    """Return `value` if both databases can store it. Raises: ValueError."""
    if isinstance(value, str) and "\x00" in value:
        raise ValueError("it contains the character U+0000, which no database keeps")
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError("it contains a number that is not finite")
    inner = (*value, *value.values()) if isinstance(value, dict) else value
    for item in inner if isinstance(inner, list | tuple) else ():
        _storable(item)
    return value


Person = Annotated[str, Field(min_length=1, max_length=150)]
Moment = Annotated[datetime, PlainValidator(_moment)]


class Line(BaseModel):
    """Record as plain JSON, as this program wrote it. Fields added later have a default; unknown fields are ignored."""

    model_config = ConfigDict(frozen=True, extra="ignore", strict=True)
    ELSEWHERE: ClassVar[frozenset[str]] = frozenset({"kind"})  # fields without a column in the row

    @field_validator("*")
    @classmethod
    def _kept(cls, value: Any) -> Any:
        return _storable(value)

    @classmethod
    def path_of(cls, name: str) -> str:
        """Return the query path of field `name` from the row."""
        paths = (mark.path for mark in cls.model_fields[name].metadata if isinstance(mark, RowPath))
        return next(paths, "") or name

    @classmethod
    def names(cls) -> Iterable[str]:
        """Return the names of the written fields, in order."""
        return cls.model_fields

    @classmethod
    def written(cls, row: Any, **given: Any) -> dict[str, Any]:
        """Return the line of a row that is about to be saved; `given` are values that the row does not have."""
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
        """Return the values of the database row.

        Usernames are replaced by their accounts. Values that are stored in other rows are omitted.
        """
        values = {}
        for name in type(self).names():
            field, _, further = type(self).path_of(name).partition("__")
            value = getattr(self, name)
            if further == "username":
                values[field] = get_or_create_person(value)
            elif not further and name not in self.ELSEWHERE and not isinstance(value, Line):
                values[field] = value
        return values


def resolve_path(row: Any, path: str) -> Any:
    """Return the value at a query path from `row`; None if an object on the path is None or missing."""
    for name in path.split("__"):
        row = getattr(row, name, None) if row is not None else None
    return row


def to_json_value(value: Any) -> Any:
    """Return a time, enumeration or UUID as a JSON value; any other value is returned unchanged."""
    if isinstance(value, datetime):
        return value.isoformat()
    if isinstance(value, Enum):
        return value.value
    return str(value) if isinstance(value, UUID) else value


AnyLine = TypeVar("AnyLine", bound=Line)


def missing_rows(model: type[Model], lines: Sequence[AnyLine], **owner: Model) -> list[AnyLine]:
    """Return the lines without a database row; if several lines have the same uuid, only the last of them.

    Raises: EvaError if a row with the uuid of a line belongs to another owner.
    """
    ((belongs, whose),) = owner.items()
    last = {line.uuid: line for line in lines}  # type: ignore[attr-defined]
    rows = dict(model._default_manager.filter(uuid__in=last).values_list("uuid", belongs))
    for uuid, owner_key in rows.items():
        if owner_key != whose.pk:
            raise EvaError(
                _ITS_IS_OF(verbose_name=model._meta.verbose_name, uuid=uuid, belongs=belongs, other=owner_key)
            )
    return [line for uuid, line in last.items() if uuid not in rows]


# --- the files ---------------------------------------------------------------------------------------------

_kinds: dict[str, tuple[type[Line], ...]] = {}  # by folder; several journals may share its files


class Journal(Generic[AnyLine]):
    """Lines of the given kinds in the files DATA/`folder`/<uuid>.jsonl."""

    def __init__(self, folder: str, *kinds: type[AnyLine]) -> None:
        self.folder = folder
        _kinds[folder] = (*_kinds.get(folder, ()), *kinds)

    def path(self, uuid: UUID) -> Path:
        """Return the file of one episode, trial or session."""
        return Path(settings.DATA_DIR) / self.folder / f"{uuid}.jsonl"

    def append(self, uuid: UUID, line: Mapping[str, Any]) -> None:
        """Append one line and wait until it is on the disk.

        The caller must hold a lock on the database row to which the file belongs.

        Raises:
            NotWritten: If the disk refuses the line.
        """
        append_line(self.path(uuid), line)

    def read(self, uuid: UUID, say: Callable[[str], None]) -> list[AnyLine]:
        """Return all valid lines of the file of `uuid`, oldest first.

        If several journals share the folder, the lines of all of them are returned. A truncated or invalid line is
        skipped: `say` is called with file, line number and field.
        """
        path, records, lines = self.path(uuid), [], _reader(_kinds[self.folder])
        for number, line in read_numbered_lines(path):
            try:
                records.append(lines.validate_json(line))
            except ValidationError as error:
                say(f"{path}: line {number} {_wrong(error)}")
        return records


@cache
def _reader(kinds: tuple[type[Line], ...]) -> TypeAdapter[Any]:
    either = Union[kinds]  # noqa: UP007  made of a list
    return TypeAdapter(Annotated[either, Field(discriminator="kind")] if len(kinds) > 1 else either)


def folders() -> list[str]:
    """Return the folders of all journals."""
    return sorted(_kinds)


def parse_model(model: type[AnyLine], content: Mapping[str, Any], what: str) -> AnyLine:
    """Return `content` as an instance of `model`. Raises: EvaError with `what` and the first problem."""
    try:
        return model.model_validate_json(json.dumps(content))
    except ValidationError as error:
        raise EvaError(f"{what} {_wrong(error)}") from None


def _wrong(error: ValidationError) -> str:
    """Return the first problem of an invalid line, worded to follow the name of the line in a sentence."""
    first = error.errors()[0]
    if first["type"] == "json_invalid":
        reason, _, _ = first["ctx"]["error"].partition(" at line ")
        return f"is not whole and was left out: {reason}"
    place = ".".join(map(str, first["loc"]))
    return f"was left out: {place}{' is ' if place else ''}{first['input']!r:.80}: {first['msg']}"


def append_line(path: Path, line: Mapping[str, Any]) -> None:
    """Append one line and sync it to the disk.

    If a crash left an incomplete line at the end, the new line is still a line of its own. The caller holds the lock of
    a database row, so that there is one writer at a time.
    Raises: NotWritten, which states whether a partly written line was removed.
    """
    text = json.dumps(
        line, allow_nan=False, separators=(",", ":")
    )  # ASCII output: line separators are escaped
    effect = "nothing was changed"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab+", buffering=0) as file:
            append_durably(file, text.encode() + b"\n")
    except OSError as error:
        if isinstance(error, AppendError) and not error.is_restored:
            effect = "what was written could not be removed: the next reconcile may read it as valid"
        raise NotWritten(_NOT_KEPT(strerror=error.strerror, path=path, done=effect)) from error


def read_numbered_lines(path: Path) -> Iterator[tuple[int, bytes]]:
    """Yield the non-empty lines with their numbers from 1; nothing if the file does not exist.

    Raises: RecordingError if it cannot be read.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror}") from error
    for number, line in enumerate(data.split(b"\n"), start=1):
        if line.strip():
            yield number, line
