"""Configuration keys whose values refer to the station's own machine, and so must not be set by clients."""

from __future__ import annotations

from collections.abc import Iterator
from enum import Enum
from typing import Annotated, Any, get_args, get_origin

from pydantic import BaseModel


class HostReference(Enum):
    """Kind of resource on this machine to which a configuration value refers."""

    VARIABLE = "an environment variable"
    FILE = "a file that is read"
    WRITTEN = "a file that is written"
    RECORDING = "a recording or a dataset"


Variable = Annotated[str, HostReference.VARIABLE]
Recording = Annotated[str, HostReference.RECORDING]


def find_host_references(table: BaseModel, prefix: str = "") -> Iterator[tuple[str, HostReference, str]]:
    """Yield (key, kind, value) for each key of a table, and of nested tables, that refers to this machine."""
    for key, field in type(table).model_fields.items():
        value = getattr(table, key)
        if isinstance(value, BaseModel):
            yield from find_host_references(value, f"{prefix}{key}.")
        elif isinstance(value, str):
            references = [
                mark
                for mark in (*field.metadata, *_marks(field.annotation))
                if isinstance(mark, HostReference)
            ]
            yield from ((prefix + key, mark, value) for mark in references)


def _marks(annotation: Any) -> Iterator[Any]:
    if get_origin(annotation) is Annotated:
        yield from annotation.__metadata__
    for part in get_args(annotation):
        yield from _marks(part)
