"""Records that are only ever added: a line on the disk before the row, from which the row can be made again.

A `Line` declares what a record has: it is written from the row, checked when it is read, and gives back what the row
is made of. A `Journal` is a folder of files of lines, a file for each episode, trial or session.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from enum import Enum
from pathlib import Path
from typing import Annotated, Any, ClassVar, Generic, TypeVar, get_args
from uuid import UUID

from django.conf import settings
from django.db.models import Model
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from evaweb.errors import EvaError
from evaweb.roles import known_person
from runtime.recording.files import RecordingError

Person = Annotated[str, Field(min_length=1, max_length=150)]


class NotKept(EvaError):
    """The disk did not take it, and so the database was not told either."""

    status = 507


def text(name: str, given: str, longest: int) -> str:
    """A text as it was typed, without blanks at its ends; EvaError where it cannot be stored."""
    if "\x00" in given:
        raise EvaError(f"{name} contains the character U+0000, which no database keeps: remove it")
    stripped = given.strip()
    if len(stripped) > longest:
        raise EvaError(f"{name} has {len(stripped)} characters; allowed: at most {longest}")
    return stripped


# --- one line ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class From:
    """Where a row has what a field of its line says, as queries name it: `rater__username`; "" under its own name."""

    path: str


class Line(BaseModel):
    """A record in plain JSON, as this program wrote it. What came later has a default; what is unknown is left."""

    model_config = ConfigDict(frozen=True, extra="ignore")
    ELSEWHERE: ClassVar[frozenset[str]] = frozenset({"kind"})  # what is in no column of the row

    @classmethod
    def path_of(cls, name: str) -> str:
        """Where the row has it."""
        found = (each.path for each in cls.model_fields[name].metadata if isinstance(each, From))
        return next(found, "") or name

    @classmethod
    def names(cls) -> Iterable[str]:
        """What is written, in this order."""
        return cls.model_fields

    @classmethod
    def written(cls, row: Any, **given: Any) -> dict[str, Any]:
        """The line of a row that is about to be saved; `given` is what the row does not say."""
        return {name: given[name] if name in given else plain(cls._value(row, name)) for name in cls.names()}

    @classmethod
    def _value(cls, row: Any, name: str) -> Any:
        field = cls.model_fields[name]
        if name in cls.ELSEWHERE:
            return field.default
        value = value_at(row, cls.path_of(name))
        nested = field.annotation
        return (
            nested.written(value)
            if isinstance(nested, type) and issubclass(nested, Line) and value
            else value
        )

    def values(self) -> dict[str, Any]:
        """What the row is made of: people as their accounts; what lies in other rows is left out."""
        found = {}
        for name in type(self).names():
            field, _, further = type(self).path_of(name).partition("__")
            value = getattr(self, name)
            if further == "username":
                found[field] = known_person(value)
            elif not further and name not in self.ELSEWHERE and not isinstance(value, Line):
                found[field] = value
        return found


def value_at(row: Any, path: str) -> Any:
    """What a path of a query leads to; None where it ends before."""
    for name in path.split("__"):
        row = getattr(row, name, None) if row is not None else None
    return row


def plain(value: Any) -> Any:
    """A value as JSON has it."""
    if isinstance(value, datetime):
        return value.isoformat()
    if isinstance(value, Enum):
        return value.value
    return str(value) if isinstance(value, UUID) else value


AnyLine = TypeVar("AnyLine", bound=Line)


def absent(model: type[Model], lines: Sequence[AnyLine], **owner: Model) -> list[AnyLine]:
    """The lines whose rows are not there, of one that was given twice the last; EvaError for one of another owner."""
    ((belongs, whose),) = owner.items()
    last = {line.uuid: line for line in lines}  # type: ignore[attr-defined]
    rows = dict(model._default_manager.filter(uuid__in=last).values_list("uuid", belongs))
    for uuid, other in rows.items():
        if other != whose.pk:
            raise EvaError(f"its {model._meta.verbose_name} {uuid} is of {belongs} {other}")
    return [line for uuid, line in last.items() if uuid not in rows]


# --- the files ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class LinesRead:
    """The whole lines of a file, oldest first, and the numbers of those that are not, from 1."""

    lines: tuple[Mapping[str, Any], ...]
    torn: tuple[int, ...]


class Journal(Generic[AnyLine]):
    """DATA/`folder`/<uuid>.jsonl. `whose` is what errors call such a file; `shared`: others have their kinds in it."""

    def __init__(self, folder: str, whose: str, *kinds: type[AnyLine], shared: bool = False) -> None:
        self.folder, self._whose, self._shared = folder, whose, shared
        self._several = len(kinds) > 1
        self._kinds = {
            kind: model for model in kinds for kind in get_args(model.model_fields["kind"].annotation)
        }

    def path(self, uuid: UUID) -> Path:
        """The file of one episode, trial or session."""
        return Path(settings.DATA_DIR) / self.folder / f"{uuid}.jsonl"

    def append(self, uuid: UUID, line: Mapping[str, Any]) -> None:
        """Add one line and wait until it is on the disk; the caller holds a row. Raises NotKept."""
        append_line(self.path(uuid), line)

    def read(self, uuid: UUID) -> list[AnyLine]:
        """What the file says, oldest first; a torn line never counted. EvaError names one that is wrong."""
        return self.parsed(uuid, read_lines(self.path(uuid)).lines)

    def parsed(self, uuid: UUID, lines: Iterable[Mapping[str, Any]]) -> list[AnyLine]:
        """The same of lines that were read; without those of other kinds where the file is shared."""
        found = (self._line(uuid, line, number) for number, line in enumerate(lines, start=1))
        return [line for line in found if line is not None]

    def _line(self, uuid: UUID, content: Mapping[str, Any], number: int) -> AnyLine | None:
        kind, what = content.get("kind"), f"line {number} of {self._whose.format(uuid=uuid)}"
        model = self._kinds.get(kind) if isinstance(kind, str) else None
        if model is not None:
            return checked(
                model, content, f"{what}: {kind}." if self._several and not self._shared else f"{what}: "
            )
        if self._shared:
            return None
        raise EvaError(f"{what}: kind is {kind!r:.80}; allowed: {', '.join(self._kinds)}")


def checked(model: type[AnyLine], content: Mapping[str, Any], what: str) -> AnyLine:
    """`content` as that model; EvaError says after `what` the first thing that is wrong with it."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise EvaError(f"{what}{place} is {first['input']!r:.80}: {first['msg']}") from None


def append_line(path: Path, line: Mapping[str, Any]) -> None:
    """Add one line and wait until it is on the disk; a line torn by a crash before it stays a line of its own.

    The caller holds a row of the database, so that there is one writer at a time. Raises NotKept.
    """
    text = json.dumps(line, allow_nan=False, separators=(",", ":"))  # ASCII: no character in it ends a line
    try:
        _written(path, text.encode() + b"\n")
    except OSError as error:
        raise NotKept(f"not kept: {error.strerror} ({path}); nothing was changed") from error


def _written(path: Path, payload: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("ab+") as file:
        new = file.tell() == 0
        if not new:
            file.seek(-1, os.SEEK_END)
            payload = payload if file.read(1) == b"\n" else b"\n" + payload
        file.write(payload)
        file.flush()
        os.fsync(file.fileno())
    if new:
        _sync_folder(path.parent)
        _sync_folder(path.parent.parent)


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def read_lines(path: Path) -> LinesRead:
    """Read a file, an absent one as empty; a line torn by a power cut never counted. RecordingError if unreadable."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return LinesRead((), ())
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror}") from error
    found = {number: _parsed(line) for number, line in enumerate(data.split(b"\n"), start=1) if line.strip()}
    lines = tuple(content for content in found.values() if content is not None)
    return LinesRead(lines, tuple(number for number, content in found.items() if content is None))


def _parsed(line: bytes) -> Mapping[str, Any] | None:
    try:
        content = json.loads(line)
    except ValueError:
        return None
    return content if isinstance(content, dict) else None
