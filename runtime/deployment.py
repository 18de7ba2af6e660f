"""Reads deployment files: TOML with `extends` and `--set key=value`; errors name file, key and value."""

from __future__ import annotations

import difflib
import hashlib
import json
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from runtime.config import Deployment
from runtime.errors import ConfigurationError

Key = tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Resolved:
    """A valid deployment, its canonical form and the hash of that."""

    deployment: Deployment
    tree: Mapping[str, Any]
    digest: str


def load(path: Path, assignments: Sequence[str] = ()) -> Resolved:
    """The deployment of `path` with `key=value` assignments on top; raises ConfigurationError.

    A `kind` is assigned before anything else, because a new kind replaces the table it stands in.
    """
    tree, origin = _read(path, ())
    parsed = [(*_assignment(text), f"--set {text}") for text in assignments]
    for key, value, source in sorted(parsed, key=lambda one: one[0][-1] != "kind"):
        _put(tree, key, value, source)
        origin = {known: where for known, where in origin.items() if known[: len(key)] != key}
        for depth in range(1, len(key)):
            origin.setdefault(key[:depth], source)
        origin[key] = source
    return resolve(tree, origin, str(path))


def resolve(tree: Mapping[str, Any], origin: Mapping[Key, str], source: str) -> Resolved:
    """Check a tree of settings; `origin` says which file or option each key came from."""
    try:
        deployment = Deployment.model_validate(tree)
    except ValidationError as invalid:
        raise ConfigurationError(
            "\n".join(_sentence(e, tree, origin, source) for e in invalid.errors())
        ) from None
    except ConfigurationError as error:  # of a variant's own check, which knows no file
        raise ConfigurationError(f"{source}: {error}") from None
    canonical = deployment.model_dump(mode="json")
    text = json.dumps(canonical, sort_keys=True, separators=(",", ":"))
    return Resolved(deployment, canonical, hashlib.sha256(text.encode()).hexdigest())


def _read(path: Path, chain: tuple[Path, ...]) -> tuple[dict[str, Any], dict[Key, str]]:
    path = path.resolve()
    if path in chain:
        raise ConfigurationError(f"{path}: extends itself by way of {' -> '.join(map(str, chain))}")
    try:
        own = tomllib.loads(path.read_text("utf-8"))
    except OSError as error:
        near = ", ".join(sorted(p.name for p in path.parent.glob("*.toml"))) or "none"
        by = f"which {chain[-1]} extends " if chain else ""
        raise ConfigurationError(
            f"{path}: {by}cannot be read ({error.strerror}); deployment files there: {near}"
        ) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{path}: is not valid TOML: {error}") from None
    parent = own.pop("extends", None)
    if parent is None:
        return own, {key: str(path) for key in _keys(own)}
    if not isinstance(parent, str):
        raise ConfigurationError(f"{path}: extends = {parent!r}: must be the name of another file")
    tree, origin = _read(path.parent / parent, (*chain, path))
    _merge(tree, own)
    origin.update({key: str(path) for key in _keys(own)})
    return tree, origin


def _merge(base: dict[str, Any], over: Mapping[str, Any]) -> None:
    """Tables merge key by key; a table of another `kind` replaces the old one whole."""
    for key, value in over.items():
        old = base.get(key)
        replaces = isinstance(value, dict) and isinstance(old, dict) and _changes_kind(old, value)
        if isinstance(value, dict) and isinstance(old, dict) and not replaces:
            _merge(old, value)
        else:
            base[key] = value


def _changes_kind(old: Mapping[str, Any], new: Mapping[str, Any]) -> bool:
    return "kind" in new and "kind" in old and new["kind"] != old["kind"]


def _keys(tree: Mapping[str, Any], prefix: Key = ()) -> list[Key]:
    keys: list[Key] = []
    for name, value in tree.items():
        keys.append((*prefix, name))
        if isinstance(value, dict):
            keys.extend(_keys(value, (*prefix, name)))
    return keys


def _assignment(text: str) -> tuple[Key, Any]:
    name, separator, raw = text.partition("=")
    if not separator or not name.strip():
        raise ConfigurationError(f"--set {text}: must be key=value, for example control.rate=30")
    try:
        value = tomllib.loads(f"value = {raw}")["value"]
    except tomllib.TOMLDecodeError:
        value = raw  # a bare word is a string, so that quotes need no escaping in a shell
    return tuple(name.strip().split(".")), value


def _put(tree: dict[str, Any], key: Key, value: Any, source: str) -> None:
    for depth, name in enumerate(key[:-1]):
        tree = tree.setdefault(name, {})
        if not isinstance(tree, dict):
            raise ConfigurationError(f"{source}: {'.'.join(key[: depth + 1])} is not a table")
    if key[-1] == "kind" and tree.get("kind") not in (None, value):
        tree.clear()  # settings of another kind would be unknown keys here
    tree[key[-1]] = value


def _sentence(error: ErrorDetails, tree: Mapping[str, Any], origin: Mapping[Key, str], source: str) -> str:
    key = _plain(error["loc"], tree)
    where = next((origin[key[:n]] for n in range(len(key), 0, -1) if key[:n] in origin), source)
    name = ".".join(key)
    kind = error["type"]
    if kind == "extra_forbidden":
        allowed = _allowed(key[:-1], tree)
        near = difflib.get_close_matches(key[-1], allowed, 1)
        hint = f" (did you mean {near[0]}?)" if near else ""
        return f"{where}: {name} = {error['input']!r}: unknown key{hint}; allowed here: {', '.join(allowed)}"
    if kind == "missing":
        return f"{where}: {name} is missing and has no default"
    if kind in ("union_tag_invalid", "union_tag_not_found"):
        where = origin.get((*key, "kind"), where)
        given = f"= {error['input']['kind']!r}" if "kind" in error["input"] else "is missing"
        return f"{where}: {name}.kind {given}: must be one of {', '.join(_kinds(key, tree))}"
    if kind in ("model_type", "model_attributes_type", "dict_type"):
        return f"{where}: {name} = {error['input']!r}: must be a table"
    return f"{where}: {name} = {error['input']!r}: {error['msg'].removeprefix('Value error, ')}"


def _plain(loc: tuple[int | str, ...], tree: Mapping[str, Any]) -> Key:
    """The key as it stands in the file: without the tags that pydantic adds for unions."""
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


def _allowed(key: Key, tree: Mapping[str, Any]) -> list[str]:
    """The keys that the table at `key` may have."""
    return sorted({name for model in _tables(key, tree) for name in model.model_fields})


def _kinds(key: Key, tree: Mapping[str, Any]) -> list[str]:
    """The kinds that the table at `key` may be of."""
    return [repr(model.model_fields["kind"].default) for model in _tables(key, tree)]


def _tables(key: Key, tree: Mapping[str, Any]) -> list[type[BaseModel]]:
    """What the table at `key` may be: one model where its kind says so, else each it could be."""
    annotations: list[Any] = [Deployment]
    at: Any = tree
    for name in key:
        annotations = [found for annotation in annotations for found in _under(name, annotation)]
        at = at.get(name) if isinstance(at, Mapping) else None
        chosen = [model for model in _models(annotations) if _is_of_kind(model, at)]
        annotations = list(chosen or annotations)
    return _models(annotations)


def _under(name: str, annotation: Any) -> list[Any]:
    """The annotations of what stands under `name` in something of type `annotation`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        field = annotation.model_fields.get(name)
        return [field.annotation] if field else []
    if get_origin(annotation) in (dict, list):
        return [get_args(annotation)[-1]]
    return [found for part in get_args(annotation) for found in _under(name, part)]


def _is_of_kind(model: type[BaseModel], table: Any) -> bool:
    declared = model.model_fields.get("kind")
    return declared is not None and isinstance(table, Mapping) and table.get("kind") == declared.default


def _models(annotations: Sequence[Any]) -> list[type[BaseModel]]:
    found: list[type[BaseModel]] = []
    for annotation in annotations:
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            found.append(annotation)
        else:
            found.extend(_models(get_args(annotation)))
    return found
