"""Base class of all tables of a deployment file, and messages for invalid tables."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, get_args, get_origin

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic_core import ErrorDetails

from runtime.core.plugins import KindUnion, variants

Key = tuple[str, ...]
_SECRET = re.compile(r"pass|secret|token|private", re.IGNORECASE)  # keys whose values are not printed
_NO_ORIGIN: Mapping[Key, str] = MappingProxyType({})


class Settings(BaseModel):
    """Frozen table of a deployment file, in which nothing is coerced.

    Unknown keys, wrong types, NaN and infinity are errors.
    """

    # A limit of infinity or NaN would not limit, and neither is valid in a manifest's JSON.
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


def explain_validation_error(
    invalid: ValidationError,
    root: type[BaseModel],
    tree: Mapping[str, Any],
    source: str,
    origin: Mapping[Key, str] = _NO_ORIGIN,
) -> str:
    """Return one line per error in `tree`, a table that the model `root` does not accept.

    A line has the key, the given value and what is allowed. `origin` maps keys to the files that they came from; all
    other keys came from `source`.
    """
    return "\n".join(_sentence(error, root, tree, source, origin) for error in invalid.errors())


def _sentence(
    error: ErrorDetails,
    root: type[BaseModel],
    tree: Mapping[str, Any],
    source: str,
    origin: Mapping[Key, str],
) -> str:
    key = _plain(error["loc"], tree)
    where = next((origin[key[:n]] for n in range(len(key), 0, -1) if key[:n] in origin), source)
    name = ".".join(key)
    kind = error["type"]
    if kind == "extra_forbidden":
        allowed = _allowed(key[:-1], tree, root)
        near = difflib.get_close_matches(key[-1], allowed, 1)
        hint = f" (did you mean {near[0]}?)" if near else ""
        value = "" if _SECRET.search(key[-1]) else f" = {error['input']!r:.200}"
        if (instead := getattr(root, "GONE", {}).get(name)) is not None:
            return f"{where}: {name}{value}: {instead}"
        return f"{where}: {name}{value}: unknown key{hint}; allowed here: {', '.join(allowed)}"
    if kind == "missing":
        return f"{where}: {name} is missing and has no default"
    if kind in ("union_tag_invalid", "union_tag_not_found"):
        tag = error["ctx"].get("discriminator", "'kind'").strip("'")
        where = origin.get((*key, tag), where)
        value = f"= {error['input'][tag]!r:.200}" if tag in error["input"] else "is missing"
        return f"{where}: {name}.{tag} {value}: must be one of {error['ctx']['expected_tags']}"
    if kind == "secret":
        return f"{where}: {name}: {error['msg']}"
    if kind in ("model_type", "model_attributes_type", "dict_type"):
        return f"{where}: {name} = {error['input']!r:.200}: must be a table"
    return f"{where}: {name} = {error['input']!r:.200}: {error['msg'].removeprefix('Value error, ')}"


def _plain(loc: tuple[int | str, ...], tree: Mapping[str, Any]) -> Key:
    """Return the key of a setting as the file has it, from `loc`, the location that pydantic reports.

    pydantic adds tags to the location where a setting is a union of models; the tags are left out. `tree` are the
    tables of the file.
    """
    key: list[str] = []
    at: Any = tree
    for index, part in enumerate(loc):
        last = index == len(loc) - 1
        if isinstance(at, Mapping) and part in at:
            at = at[part]
            key.append(str(part))
        elif isinstance(at, list) and isinstance(part, int):
            at = at[part] if part < len(at) else None
            key.append(str(part))
        elif last and isinstance(at, Mapping) and at.get("kind") != part:
            key.append(str(part))
    return tuple(key)


def _allowed(key: Key, tree: Mapping[str, Any], root: type[BaseModel]) -> list[str]:
    """Return the keys that the table at `key` may have."""
    return sorted({name for model in _tables(key, tree, root) for name in model.model_fields})


def _tables(key: Key, tree: Mapping[str, Any], root: type[BaseModel]) -> list[type[BaseModel]]:
    """Return the models that the table at `key` may have: a single one if its kind is known, else all candidates."""
    annotations: list[Any] = [root]
    at: Any = tree
    for name in key:
        at = at.get(name) if isinstance(at, Mapping) else None
        annotations = [
            chosen
            for annotation in annotations
            for table in _under(name, annotation)
            for chosen in _chosen(table, at)
        ]
    return _models(annotations)


def _under(name: str, annotation: Any) -> list[Any]:
    """Return the types that the value of the key `name` may have, in a table or list of the type `annotation`.

    [] if there is no such key.
    """
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        field = annotation.model_fields.get(name)
        return [field.annotation] if field else []
    if get_origin(annotation) in (dict, list):
        return [get_args(annotation)[-1]]
    return [model for part in get_args(annotation) for model in _under(name, part)]


def _chosen(annotation: Any, table: Any) -> list[Any]:
    """Return the types, out of those that `annotation` allows, that `table` may have.

    If `annotation` has several kinds, only the model of the kind that `table` names is returned; [] if it names no
    valid kind.
    """
    if isinstance(annotation, type) and issubclass(annotation, KindUnion):
        kind = table.get("kind") if isinstance(table, Mapping) else None
        return (
            [annotation.config(kind)]
            if isinstance(kind, str) and kind in variants(annotation.package)
            else []
        )
    if get_origin(annotation) in (dict, list) or not get_args(annotation):
        return [annotation]
    return [model for part in get_args(annotation) for model in _chosen(part, table)]


def _models(annotations: Sequence[Any]) -> list[type[BaseModel]]:
    models: list[type[BaseModel]] = []
    for annotation in annotations:
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            models.append(annotation)
        else:
            models.extend(_models(get_args(annotation)))
    return models
