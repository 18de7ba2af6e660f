"""Finds the variants of a part: every public module of its package that declares a `Config`."""

from __future__ import annotations

import functools
import importlib
import pkgutil
from functools import reduce
from operator import or_
from types import ModuleType
from typing import Annotated, Any

from pydantic import Field

from runtime.core.errors import ConfigurationError


@functools.cache
def variants(package: str) -> dict[str, ModuleType]:
    """The modules of `package` by their `kind`; adding a file there is all it takes to add a variant.

    Raises ConfigurationError where two modules claim the same kind.
    """
    root = importlib.import_module(package)
    found: dict[str, ModuleType] = {}
    for info in pkgutil.iter_modules(root.__path__):
        if info.name.startswith("_"):
            continue
        module = importlib.import_module(f"{package}.{info.name}")
        if not hasattr(module, "Config"):
            continue
        kind = module.Config.model_fields["kind"].default
        if kind in found:
            raise ConfigurationError(
                f"{module.__name__} declares the kind {kind!r}, which is {found[kind].__name__}'s; "
                f"allowed: any but {', '.join(found)}"
            )
        found[kind] = module
    return found


def union(package: str) -> Any:
    """The union of the variants' Configs, told apart by `kind`; a new file in the package joins by itself."""
    configs = [module.Config for module in variants(package).values()]
    made = reduce(or_, configs)
    return Annotated[made, Field(discriminator="kind")] if len(configs) > 1 else made
