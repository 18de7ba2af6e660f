"""Variants of a part, each a module that is imported by name, and only where a deployment names its kind."""

from __future__ import annotations

import functools
import importlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar, get_args

from pydantic import BaseModel, ConfigDict, GetCoreSchemaHandler, GetJsonSchemaHandler, ValidationInfo
from pydantic_core import CoreSchema, PydanticKnownError, core_schema

from runtime.core.errors import ConfigurationError


class Variants(Mapping[str, ModuleType]):
    """The modules of a package by their `kind`, as its table KINDS names them; each is imported when it is asked for.

    Raises ConfigurationError, which names file and cause, for one that cannot be imported.
    """

    def __init__(self, package: str) -> None:
        self._package = package
        root = importlib.import_module(package)
        self._folder = Path(root.__path__[0])
        self._modules: Mapping[str, str] = root.KINDS

    def __getitem__(self, kind: str) -> ModuleType:
        name = self._modules[kind]
        try:
            return importlib.import_module(name)
        except (Exception, SystemExit) as error:  # of anybody's code: it is told where a deployment names it
            file = self._folder / f"{name.rpartition('.')[2]}.py"
            raise ConfigurationError(
                f"{self._package.rpartition('.')[2]}: the kind {kind!r} cannot be loaded: {file}: "
                f"{type(error).__name__}: {error}"
            ) from error

    def __contains__(self, kind: object) -> bool:
        return kind in self._modules

    def __iter__(self) -> Iterator[str]:
        return iter(self._modules)

    def __len__(self) -> int:
        return len(self._modules)


@functools.cache  # cache: of tables in the code
def variants(package: str) -> Variants:
    """The variants that `package` names in its table KINDS."""
    return Variants(package)


class UnreadSection(BaseModel):
    """A table that this process has no use for: as it was written, by its kind, with nothing of it loaded."""

    model_config = ConfigDict(extra="allow", frozen=True)

    kind: str


class KindUnion:
    """The type of a table of one of a package's kinds, told apart by `kind`.

    A kind is imported when a table names it. A package that the context of the validation has under `unread` is
    left alone: its tables become an UnreadSection each.
    """

    package: ClassVar[str]

    @classmethod
    def config(cls, kind: str) -> type[BaseModel]:
        """The model of the tables of a kind."""
        found: type[BaseModel] = variants(cls.package)[kind].Config
        return found

    @classmethod
    def configs(cls) -> tuple[type[BaseModel], ...]:
        """The models of all kinds: imports them all."""
        return tuple(cls.config(kind) for kind in variants(cls.package))

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.with_info_plain_validator_function(cls._validated)

    @classmethod
    def __get_pydantic_json_schema__(
        cls, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        return {"description": "A table of one of several kinds."}

    @classmethod
    def _validated(cls, table: Any, info: ValidationInfo) -> BaseModel:
        if isinstance(table, BaseModel):
            return table
        if not isinstance(table, Mapping):
            raise PydanticKnownError("model_attributes_type")
        if cls.package in (info.context or {}).get("unread", ()):
            return UnreadSection.model_validate(table)
        kind, known = table.get("kind"), variants(cls.package)
        if not isinstance(kind, str) or kind not in known:
            tags = ", ".join(map(repr, known))
            context = {"discriminator": "'kind'", "tag": str(kind), "expected_tags": tags}
            raise PydanticKnownError("union_tag_invalid", context)
        return cls.config(kind).model_validate(table)


def kind_union(package: str) -> Any:
    """The type of a table of one of the package's kinds."""
    return type("OneOf", (KindUnion,), {"package": package, "__doc__": KindUnion.__doc__})


def union_members(annotation: Any) -> tuple[Any, ...]:
    """Parts of an annotation: the models of all kinds of a table that has kinds, else its arguments."""
    if isinstance(annotation, type) and issubclass(annotation, KindUnion):
        return annotation.configs()
    return get_args(annotation)
