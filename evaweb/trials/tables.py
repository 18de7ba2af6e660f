"""Checks tables that an administrator writes as JSON: how a policy is reached, how a bench is laid out."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from difflib import get_close_matches
from functools import cache
from typing import Any, get_args

import pydantic
from django.core.exceptions import ValidationError

from runtime.config.schema import policy_tables

_TAG = re.compile(r"[A-Za-z0-9_.:/+-]{1,40}")
_PLACES = {"block": ("x", "y", "yaw in degrees"), "plate": ("x", "y")}


def check_policy(given: object) -> None:
    """ValidationError unless `given` fits on top of a deployment's [policy] table of some kind."""
    if not isinstance(given, Mapping):
        raise ValidationError(_sentence(given, 'a table such as {"url": "ws://127.0.0.1:8000"}'))
    kinds = _kinds()
    wanted = given.get("kind")
    if wanted is not None and wanted not in kinds:
        raise ValidationError(f"kind = {wanted!r}; allowed: {', '.join(kinds)}")
    problems = {kind: _problems(given, kinds[kind]) for kind in ([wanted] if wanted else kinds)}
    if all(problems.values()):
        raise ValidationError(problems[max(problems, key=lambda kind: _likeness(given, kinds[kind]))])


def check_tags(given: object) -> None:
    """ValidationError unless `given` is a list of different short words."""
    words = isinstance(given, list) and all(isinstance(tag, str) and _TAG.fullmatch(tag) for tag in given)
    if not words:
        raise ValidationError(_sentence(given, "words of at most 40 letters a to z, digits and ._:/+-"))
    if len(set(given)) < len(given):  # type: ignore[arg-type, call-overload]
        raise ValidationError(_sentence(given, "each tag once"))


def check_bench(given: object) -> None:
    """ValidationError unless `given` says where things lie: "block": [x, y, yaw], "plate": [x, y]."""
    if given is None:
        return
    if not isinstance(given, Mapping):
        raise ValidationError(
            _sentence(given, 'a table such as {"block": [0.1, 0.3, 0], "plate": [-0.1, 0.3]}')
        )
    problems = [problem for key, value in given.items() if (problem := _place_problem(key, value))]
    if problems:
        raise ValidationError(problems)


def _place_problem(key: object, value: object) -> str:
    if key not in _PLACES:
        return f"{key}: unknown key; allowed: {', '.join(_PLACES)}"
    parts = _PLACES[str(key)]
    numbers = isinstance(value, list) and all(_is_number(part) for part in value)
    if not numbers or len(value) != len(parts):  # type: ignore[arg-type]
        return _sentence(value, f"{len(parts)} numbers: [{', '.join(parts)}], x and y in metres", str(key))
    if max(map(abs, value[:2])) > 2:  # type: ignore[index]
        return _sentence(value, "x and y in metres, at most 2 from the middle", str(key))
    return ""


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _problems(given: Mapping[str, Any], config: type[pydantic.BaseModel]) -> list[str]:
    """Errors of it as a table of that kind; what is missing comes from the deployment."""
    kind = config.model_fields["kind"].default
    try:
        config.model_validate({**given, "kind": kind})
    except pydantic.ValidationError as invalid:
        errors = [error for error in invalid.errors() if error["type"] != "missing"]
        return [_problem(error, config, kind) for error in errors]
    return []


def _likeness(given: Mapping[str, Any], config: type[pydantic.BaseModel]) -> tuple[int, int]:
    """Number of keys that are, or nearly are, those of this kind; of two alike, the kind with more keys."""
    near = [key for key in given if get_close_matches(str(key), config.model_fields, n=1)]
    return len(near), len(config.model_fields)


def _problem(error: Any, config: type[pydantic.BaseModel], kind: str) -> str:
    key = ".".join(map(str, error["loc"])) or "policy"
    if error["type"] == "extra_forbidden":
        table = _table(config, error["loc"][:-1])
        return f"{key}: unknown key for kind {kind!r}; allowed: {', '.join(table.model_fields)}"
    if error["type"] == "secret":  # not shown, and not in any log
        return f"{key}: {error['msg']}"
    return f"{key} = {error['input']!r:.80}: {error['msg'].removeprefix('Value error, ')}"


def _table(config: type[pydantic.BaseModel], way: tuple[str | int, ...]) -> type[pydantic.BaseModel]:
    """The table within `config` to which the keys of `way` lead."""
    for key in way:
        field = config.model_fields.get(str(key))
        parts = (field.annotation, *get_args(field.annotation)) if field else ()
        within = [part for part in parts if isinstance(part, type) and issubclass(part, pydantic.BaseModel)]
        config = within[0] if within else config
    return config


@cache
def _kinds() -> dict[str, type[pydantic.BaseModel]]:
    kinds = {config.model_fields["kind"].default: config for config in policy_tables()}
    return {kind: config for kind, config in kinds.items() if kind != "none"}  # no policy is no checkpoint


def _sentence(given: object, allowed: str, name: str = "") -> str:
    return f"{name}{' = ' if name else ''}{given!r:.80}; allowed: {allowed}"
