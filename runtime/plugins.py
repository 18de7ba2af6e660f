"""Finds the variants of a part: every public module of its package that declares a `Config`."""

from __future__ import annotations

import functools
import importlib
import pkgutil
from types import ModuleType


@functools.cache
def variants(package: str) -> dict[str, ModuleType]:
    """The modules of `package` by their `kind`; adding a file there is all it takes to add a variant."""
    root = importlib.import_module(package)
    found = {}
    for info in pkgutil.iter_modules(root.__path__):
        module = importlib.import_module(f"{package}.{info.name}")
        if hasattr(module, "Config"):
            found[module.Config.model_fields["kind"].default] = module
    return found
