"""First deployment file of a station: the choices that a person has, and the text of the file for these choices."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from runtime.config.reference import first_line, meaning, own_first
from runtime.core.errors import ConfigurationError
from runtime.core.plugins import variants

PACKAGES = {"transport": "runtime.transports", "cameras": "runtime.cameras", "policy": "runtime.policies"}
_SCALARS = {"string": "text", "integer": "whole", "number": "number", "boolean": "yes"}


@dataclass(frozen=True, slots=True)
class Entry:
    """One key of a deployment's table, for a value that is no table or list.

    `type` is "text", "whole" (a whole number), "number", "yes" (yes or no) or "choice".
    """

    key: str
    type: str
    choices: tuple[str, ...]
    default: str  # as typed, "" for none
    required: bool
    meaning: str

    @property
    def address(self) -> bool:
        """Whether the value of the key is asked first.

        This is so for addresses and similar values, which have no useful default, and for all required keys.
        """
        return (
            self.required
            or self.key in ("url", "network", "master", "address", "domain", "user")
            or (self.key.endswith("_endpoint"))
        )

    def value(self, typed: str) -> Any:
        """Convert typed text to the key's value. Raises ConfigurationError with the allowed values."""
        if self.type == "yes":
            return _one_of(self.key, typed, {"yes": True, "no": False})
        if self.type == "choice":
            return _one_of(self.key, typed, {word: json.loads(word) for word in self.choices})
        if self.type == "text":
            return typed
        try:
            return int(typed) if self.type == "whole" else float(typed)
        except ValueError:
            expected = "a whole number" if self.type == "whole" else "a number"
            raise ConfigurationError(f"{self.key} = {typed!r:.80}; allowed: {expected}") from None


def kinds(part: str) -> dict[str, str]:
    """Return by kind the description of each kind of a part; `part` is a key of PACKAGES, such as "policy".

    If a kind cannot be loaded here, the description is the reason for that.
    """
    return {kind: _about(part, kind) for kind in variants(PACKAGES[part])}


def entries(part: str, kind: str) -> tuple[Entry, ...]:
    """Return the keys of the table that configures a part (a key of PACKAGES) with a `kind`.

    Keys that only this kind has come before those that all kinds have. Raises ConfigurationError, which lists the known
    kinds.
    """
    kinds = variants(PACKAGES[part])
    if kind not in kinds:
        raise ConfigurationError(f"{part}.kind = {kind!r:.40}; allowed: {', '.join(kinds)}")
    return tuple(_entries(kinds[kind].Config))


def table(part: str, kind: str, typed: Mapping[str, str]) -> dict[str, Any]:
    """Return the table of a part with the values in `typed`, without keys that are empty or equal to their default."""
    values: dict[str, Any] = {"kind": kind}
    for entry in entries(part, kind):
        text = typed.get(entry.key, "").strip()
        if text and text != entry.default:
            values[entry.key] = entry.value(text)
    return values


def text_of(tree: Mapping[str, Any], comments: Sequence[str]) -> str:
    """Return a deployment file as TOML: scalars, lists of scalars, and tables."""
    return "\n".join([*(f"# {line}" for line in comments), *_lines(tree, ())]) + "\n"


def _about(part: str, kind: str) -> str:
    try:
        return first_line(variants(PACKAGES[part])[kind].Config)
    except ConfigurationError as fault:
        return str(fault)


def _entries(model: type[BaseModel]) -> Iterator[Entry]:
    properties = model.model_json_schema()["properties"]
    for name, field in own_first(model):
        schema = _non_null_schema(properties[name])
        choices = tuple(json.dumps(value) for value in schema.get("enum", ()))
        scalar = "choice" if choices else _SCALARS.get(str(schema.get("type")), "")
        if name != "kind" and scalar:
            default = _default(field, choices)
            yield Entry(name, scalar, choices, default, field.is_required(), meaning(model, name, field))


def _non_null_schema(schema: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the schema of a key that may also be null, without the null."""
    parts = [part for part in schema.get("anyOf", ()) if part.get("type") != "null"]
    return parts[0] if len(parts) == 1 else schema


def _default(field: FieldInfo, choices: tuple[str, ...]) -> str:
    value = None if field.is_required() else field.get_default(call_default_factory=True)
    if value is None:
        return ""
    if isinstance(value, bool) and not choices:
        return "yes" if value else "no"
    return json.dumps(value) if choices else str(value)


def _one_of(key: str, typed: str, allowed: Mapping[str, Any]) -> Any:
    if typed not in allowed:
        raise ConfigurationError(f"{key} = {typed!r:.80}; allowed: {', '.join(allowed)}")
    return allowed[typed]


def _lines(tree: Mapping[str, Any], path: tuple[str, ...]) -> Iterator[str]:
    if path:
        yield f"\n[{'.'.join(path)}]"
    for key, value in tree.items():
        if not isinstance(value, Mapping):
            yield f"{_bare(key)} = {json.dumps(value, ensure_ascii=False)}"
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from _lines(value, (*path, _bare(key)))


def _bare(key: str) -> str:
    plain = key.replace("_", "").replace("-", "")
    return key if plain.isascii() and plain.isalnum() else json.dumps(key, ensure_ascii=False)
