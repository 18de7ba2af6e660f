"""Reads deployment files: TOML with `extends`, `--set key=value`, and errors that name file, key and value."""

from __future__ import annotations

import difflib
import hashlib
import json
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

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
    """The deployment of `path` with `key=value` assignments on top; raises ConfigurationError."""
    tree, origin = _read(path, ())
    for assignment in assignments:
        key, value = _assignment(assignment)
        _put(tree, key, value, f"--set {assignment}")
        origin[key] = f"--set {assignment}"
    return resolve(tree, origin, str(path))


def resolve(tree: Mapping[str, Any], origin: Mapping[Key, str], source: str) -> Resolved:
    """Check a tree of settings; `origin` says which file or option each key came from."""
    try:
        deployment = Deployment.model_validate(tree)
    except ValidationError as invalid:
        raise ConfigurationError(
            "\n".join(_sentence(e, tree, origin, source) for e in invalid.errors())
        ) from None
    canonical = deployment.model_dump(mode="json")
    text = json.dumps(canonical, sort_keys=True, separators=(",", ":"))
    return Resolved(deployment, canonical, hashlib.sha256(text.encode()).hexdigest())


def _read(path: Path, chain: tuple[Path, ...]) -> tuple[dict[str, Any], dict[Key, str]]:
    path = path.absolute()
    if path in chain:
        raise ConfigurationError(f"{path}: extends itself by way of {' -> '.join(map(str, chain))}")
    try:
        own = tomllib.loads(path.read_text("utf-8"))
    except OSError as error:
        near = ", ".join(sorted(p.name for p in path.parent.glob("*.toml"))) or "none"
        raise ConfigurationError(
            f"{path}: cannot be read ({error.strerror}); deployment files there: {near}"
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
        hint = f"; did you mean {near[0]}?" if near else ""
        return f"{where}: {name} = {error['input']!r}: unknown key{hint} Allowed here: {', '.join(allowed)}"
    if kind == "missing":
        return f"{where}: {name} is missing and has no default"
    if kind in ("union_tag_invalid", "union_tag_not_found"):
        given = error["input"].get("kind") if isinstance(error["input"], dict) else error["input"]
        tags = error.get("ctx", {}).get("expected_tags", "")
        return f"{where}: {name}.kind = {given!r}: must be one of {tags}"
    return f"{where}: {name} = {error['input']!r}: {error['msg']}"


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
    models: list[type[BaseModel]] = [Deployment]
    at: Any = tree
    for name in key:
        at = at.get(name, {})
        fields = [m.model_fields[name].annotation for m in models if name in m.model_fields]
        models = [leaf for field in fields for leaf in _models(field)]
    chosen = [
        m for m in models if "kind" in m.model_fields and m.model_fields["kind"].default == at.get("kind")
    ]
    return sorted({name for model in (chosen or models) for name in model.model_fields})


def _models(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in get_args(annotation) for model in _models(part)]
