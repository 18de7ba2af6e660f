"""Loading of deployment files: TOML with `extends` and `--set key=value`; errors name file, key and value."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from pydantic import ValidationError

from runtime.config.schema import Deployment
from runtime.core import bounded_documents as bounded
from runtime.core.errors import ConfigurationError
from runtime.core.settings import Key, explain_validation_error

__all__ = [
    "ConfigurationError",
    "Deployment",
    "Resolved",
    "apply_assignments",
    "apply_changes",
    "config_digest",
    "load",
    "resolve_deployment",
    "server_address",
    "tree_of",
]


@dataclass(frozen=True, slots=True)
class Resolved:
    """Valid deployment, with its canonical form and the digest of that form."""

    deployment: Deployment
    tree: Mapping[str, Any]
    digest: str


def load(path: Path, assignments: Sequence[str] = ()) -> Resolved:
    """Load the deployment of `path`, changed by `key=value` assignments. Raises ConfigurationError.

    A `kind` is assigned before all other keys, because a new kind replaces its whole table.
    """
    tree, origin = _read(path, ())
    return apply_assignments(tree, origin, str(path), assignments)


def tree_of(path: Path) -> dict[str, Any]:
    """Return the unchecked content of a file merged over the files that it extends. Raises ConfigurationError."""
    return _read(path, ())[0]


def apply_assignments(
    tree: dict[str, Any], origin: dict[Key, str], source: str, assignments: Sequence[str]
) -> Resolved:
    """Apply `key=value` assignments to `tree` as `load` does, and return the deployment in it; `tree` is modified.

    `origin` maps keys to the file or option that each came from, for errors; all other keys came from `source`.
    """
    parsed = [(*_assignment(text), f"--set {text}") for text in assignments]
    for key, value, option in sorted(parsed, key=lambda one: one[0][-1] != "kind"):
        _set_key(tree, key, value, option)
        origin = {known: where for known, where in origin.items() if known[: len(key)] != key}
        for depth in range(1, len(key)):
            origin.setdefault(key[:depth], option)
        origin[key] = option
    return resolve_deployment(tree, origin, source)


def resolve_deployment(
    tree: Mapping[str, Any], origin: Mapping[Key, str], source: str, unread: Collection[str] = ()
) -> Resolved:
    """Return the deployment in a tree of settings after checking it.

    `origin` names the file or option that each key came from, for errors. Tables whose kind is a module of one of the
    packages in `unread` remain plain tables. Raises ConfigurationError.
    """
    try:
        deployment = Deployment.model_validate(tree, context={"unread": unread})
    except ValidationError as invalid:
        raise ConfigurationError(
            explain_validation_error(invalid, Deployment, tree, source, origin)
        ) from None
    except ConfigurationError as error:  # from a variant's own check, which does not know the file
        raise ConfigurationError(f"{source}: {error}") from None
    canonical = deployment.model_dump(mode="json")
    return Resolved(deployment, canonical, config_digest(canonical))


def config_digest(canonical: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a deployment in its canonical form, which may come from a manifest."""
    text = json.dumps(canonical, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def apply_changes(resolved: Resolved, changes: Mapping[str, Any], source: str) -> Resolved:
    """Return `resolved` with the tables of `changes` merged over it, as if a file with them extended it.

    Raises ConfigurationError, which names `source` as the origin of the changed keys.
    """
    tree = deepcopy(dict(resolved.tree))
    _merge(tree, deepcopy(dict(changes)))
    return resolve_deployment(tree, dict.fromkeys(_keys(changes), source), source)


def server_address(settings: Deployment) -> str:
    """Return host and port of the policy's server in a canonical spelling; "" for a policy without a server.

    Two deployments on one machine use the same server if this text is the same for both. Behind a tunnel, the text has
    host and port as seen from the far end, followed by the tunnel's host.
    """
    policy = settings.policy
    url = urlsplit(str(getattr(policy, "url", "")))
    if not url.hostname:
        return ""
    host = "127.0.0.1" if url.hostname in ("localhost", "::1") else url.hostname
    place = f"{host}:{url.port or (443 if url.scheme == 'wss' else 80)}"
    tunnel = getattr(policy, "tunnel", None)
    return place if tunnel is None else f"{place} from {tunnel.host}"


def _read(path: Path, chain: tuple[Path, ...]) -> tuple[dict[str, Any], dict[Key, str]]:
    path = path.resolve()
    if path in chain:
        raise ConfigurationError(f"{path}: extends itself by way of {' -> '.join(map(str, chain))}")
    try:
        own = bounded.load_toml(path, str(path))
    except OSError as error:
        near = ", ".join(sorted(p.name for p in path.parent.glob("*.toml"))) or "none"
        by = f"which {chain[-1]} extends " if chain else ""
        raise ConfigurationError(
            f"{path}: {by}cannot be read ({error.strerror}); deployment files there: {near}"
        ) from None
    except bounded.UnreadableDocument as error:
        raise ConfigurationError(str(error)) from None
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
    """Merge tables key by key; a table of another `kind` replaces the old table as a whole."""
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
        value = bounded.parse_toml(f"value = {raw}", f"--set {name}")["value"]
    except bounded.UnreadableDocument:
        value = raw  # a bare word is a string, so that quotes need no escaping in a shell
    return tuple(name.strip().split(".")), value


def _set_key(tree: dict[str, Any], key: Key, value: Any, source: str) -> None:
    for depth, name in enumerate(key[:-1]):
        tree = tree.setdefault(name, {})
        if not isinstance(tree, dict):
            raise ConfigurationError(f"{source}: {'.'.join(key[: depth + 1])} is not a table")
    if key[-1] == "kind" and tree.get("kind") not in (None, value):
        tree.clear()  # settings of the other kind would be unknown keys
    tree[key[-1]] = value
