"""Canonical JSON of a plan, whose digest identifies the plan, and the differences between two plans.

The form is that of RFC 8785 for the values that a plan may contain: keys sorted by code point, no spaces, UTF-8,
numbers as Python writes them, which for integers and for floats of everyday size equals ECMAScript.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from evaweb.core.errors import EvaError
from runtime.core.sentences import Pattern

_ALLOWED_FINITE_NUMBERS = Pattern(
    "canonical.allowed_finite_numbers",
    "{where} = {value}; allowed: finite numbers",
)
_HAS_KEY_ALLOWED_TEXTS = Pattern(
    "canonical.has_key_allowed_texts",
    "{where} has the key {key!r}; allowed: texts",
)
_ALLOWED_WHAT_JSON_HAS = Pattern(
    "canonical.allowed_what_json_has",
    "{where} is a {name}; allowed: what JSON has",
)

_MISSING = object()


def canonical(document: Mapping[str, Any]) -> bytes:
    """Return the canonical JSON of `document`. Raises: EvaError that names a value without canonical form."""
    return json.dumps(
        _plain(document, ""), sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
    ).encode()


def digest(document: Mapping[str, Any]) -> str:
    """Return the SHA-256 of the canonical form, in hexadecimal."""
    return hashlib.sha256(canonical(document)).hexdigest()


def difference(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Return the changes from `old` to `new`, one line each: place, old value, new value."""
    return list(_differences(_plain(old, ""), _plain(new, ""), ""))


def _plain(value: Any, where: str) -> Any:
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, float):
        if not math.isfinite(value):
            raise EvaError(_ALLOWED_FINITE_NUMBERS(where=where or "plan", value=value))
        return int(value) if value.is_integer() and abs(value) < 2**53 else value
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, str):
                raise EvaError(_HAS_KEY_ALLOWED_TEXTS(where=where or "plan", key=key))
        return {key: _plain(inner, f"{where}.{key}" if where else key) for key, inner in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, (bytes, bytearray)):
        return [_plain(inner, f"{where}[{i}]") for i, inner in enumerate(value)]
    raise EvaError(_ALLOWED_WHAT_JSON_HAS(where=where or "plan", name=type(value).__name__))


def _differences(old: Any, new: Any, where: str) -> Iterator[str]:
    if isinstance(old, dict) and isinstance(new, dict):
        for key in sorted({*old, *new}):
            yield from _differences(
                old.get(key, _MISSING), new.get(key, _MISSING), f"{where}.{key}" if where else key
            )
    elif isinstance(old, list) and isinstance(new, list):
        for i in range(max(len(old), len(new))):
            yield from _differences(
                old[i] if i < len(old) else _MISSING, new[i] if i < len(new) else _MISSING, f"{where}[{i}]"
            )
    elif old is _MISSING:
        yield f"{where}: new, {_written(new)}"
    elif new is _MISSING:
        yield f"{where}: gone, was {_written(old)}"
    elif type(old) is not type(new) or old != new:
        yield f"{where}: {_written(old)} -> {_written(new)}"


def _written(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, sort_keys=True)
