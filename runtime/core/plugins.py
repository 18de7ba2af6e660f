"""Plug-ins: modules that are imported by name, and only if a deployment names their kind."""

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
    """Modules of a package by `kind`, from its table KINDS; each is imported on first access.

    Raises:
        ConfigurationError: a module cannot be imported; names file and cause.
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
        except (Exception, SystemExit) as error:  # third-party code: reported with the deployment's key
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
    """Return the variants in the table KINDS of `package`."""
    return Variants(package)


class UnreadSection(BaseModel):
    """Table of a deployment that this process does not use.

    Its keys, with `kind`, are kept as they are. The module of its kind is not imported.
    """

    model_config = ConfigDict(extra="allow", frozen=True)

    kind: str


class KindUnion:
    """Type of a table in a deployment file whose key `kind` names a module, for example a policy's protocol.

    The modules of all kinds are in one package. A table is checked by the model of its kind, and the module of this
    kind is imported only then. If the validation context lists the package under `unread`, tables of this package are
    not checked: each becomes an UnreadSection.
    """

    package: ClassVar[str]

    @classmethod
    def config(cls, kind: str) -> type[BaseModel]:
        """Return the model of the tables of kind `kind`."""
        config: type[BaseModel] = variants(cls.package)[kind].Config
        return config

    @classmethod
    def configs(cls) -> tuple[type[BaseModel], ...]:
        """Return the models of all kinds, which imports them all."""
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
        kind, kinds = table.get("kind"), variants(cls.package)
        if not isinstance(kind, str) or kind not in kinds:
            tags = ", ".join(map(repr, kinds))
            context = {"discriminator": "'kind'", "tag": str(kind), "expected_tags": tags}
            raise PydanticKnownError("union_tag_invalid", context)
        return cls.config(kind).model_validate(table)


def kind_union(package: str) -> Any:
    """Return a type for tables whose entry `kind` names a module of `package`."""
    return type("OneOf", (KindUnion,), {"package": package, "__doc__": KindUnion.__doc__})


def union_members(annotation: Any) -> tuple[Any, ...]:
    """Return the members of an annotation: the models of all kinds for a KindUnion, else its type arguments."""
    if isinstance(annotation, type) and issubclass(annotation, KindUnion):
        return annotation.configs()
    return get_args(annotation)
