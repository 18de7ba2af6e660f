"""Validators of JSON tables written by administrators: policies, strategies, benches."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from functools import cache
from typing import Any, get_args

import pydantic
from django.core.exceptions import ValidationError

from evaweb.trials.failure_text import is_unspecified
from runtime.benches.schema import DEFAULT_BENCH, BenchSchema, UnusableBench, is_place, load_schema
from runtime.config.schema import policy_tables, strategy_tables

_TAG = re.compile(r"[A-Za-z0-9_.:/+-]{1,40}")
_OTHER_KEYS = ("objects", "factors", "choices")  # keys of a layout that are no objects of a simulated bench
_OBJECT_NAME = re.compile(r"[^\W_](?:[\w .-]{0,38}[\w.-])?")
_SMALLEST, _LARGEST = 0.005, 1.0  # side of an object [m]
_OBJECT = ("x", "y", "yaw in degrees", "width", "depth")


def check_policy(given: object) -> None:
    """Raise ValidationError unless `given` can override the [policy] table of a deployment with any kind of policy."""
    _check_kinds(given, _kinds(), '{"url": "ws://127.0.0.1:8000"}')


def check_strategy(given: object) -> None:
    """Raise ValidationError unless `given` is None or can override the [strategy] table of a deployment."""
    if given is not None:
        _check_kinds(given, _strategies(), '{"kind": "rtc", "inference_rate": 5}')


def _check_kinds(value: object, kinds: Mapping[str, type[pydantic.BaseModel]], example: str) -> None:
    if not isinstance(value, Mapping):
        raise ValidationError(_sentence(value, f"a table such as {example}"))
    requested = value.get("kind")
    if requested is not None and not (isinstance(requested, str) and requested in kinds):
        raise ValidationError(f"kind = {requested!r}; allowed: {', '.join(kinds)}")
    problems = {kind: _problems(value, kinds[kind]) for kind in ([requested] if requested else kinds)}
    if all(problems.values()):
        raise ValidationError(problems[max(problems, key=lambda kind: _matching_keys(value, kinds[kind]))])


def check_tags(given: object) -> None:
    """Raise ValidationError unless `given` is a list of distinct short words."""
    is_valid = isinstance(given, list) and all(isinstance(tag, str) and _TAG.fullmatch(tag) for tag in given)
    if not is_valid:
        raise ValidationError(_sentence(given, "words of at most 40 letters a to z, digits and ._:/+-"))
    if len(set(given)) < len(given):  # type: ignore[arg-type, call-overload]
        raise ValidationError(_sentence(given, "each tag once"))


def check_bench_name(given: str) -> None:
    """Raise ValidationError unless `given` is an installed bench or the path of a bench's folder."""
    try:
        load_schema(given)
    except UnusableBench as error:
        raise ValidationError(str(error)) from None


def check_term(given: str) -> None:
    """Raise ValidationError if a failure phase or cause could be confused with another or with "not specified"."""
    if given != given.strip():
        raise ValidationError(_sentence(given, "words without blanks around them"))
    if is_unspecified(given):
        raise ValidationError(_sentence(given, "other words: these mean a failure that is not specified"))


def check_milestones(texts: Sequence[str]) -> None:
    """Raise ValidationError if two milestones of a scene have the same text: results could not distinguish them."""
    repeated = next((text for text in texts if texts.count(text) > 1), None)
    if repeated is not None:
        raise ValidationError(
            f"two milestones are {repeated!r:.80}; allowed: different words for each of a scene"
        )


def check_bench(given: object) -> None:
    """Raise ValidationError unless `given` is None or the layout of some bench.

    The objects of a simulated bench, such as "block": [x, y, yaw] and "plate": [x, y], are keys of their own.
    "objects" are for benches laid out by people: name -> [x, y, yaw, width, depth]. "factors" are for simulated ones:
    name -> value; "choices" for those with a program of their own: name -> word. Lengths are in metres, yaw in
    degrees. `layout_problems` compares it with one simulated bench.
    """
    if given is None:
        return
    if not isinstance(given, Mapping):
        raise ValidationError(
            _sentence(given, f"a table such as {json.dumps(example_layout(load_schema(DEFAULT_BENCH)))}")
        )
    objects, factors, choices = (given.get(key, {}) for key in _OTHER_KEYS)
    if not isinstance(factors, Mapping):
        raise ValidationError(_sentence(factors, 'a table such as {"light": 0.6}', "factors"))
    if not isinstance(choices, Mapping):
        raise ValidationError(_sentence(choices, 'a table such as {"task": "reach-v3"}', "choices"))
    if not isinstance(objects, Mapping):
        raise ValidationError(
            _sentence(objects, 'a table such as {"cup": [0.1, 0.3, 0, 0.08, 0.08]}', "objects")
        )
    problems = [problem for problem in map(_object_problem, objects, objects.values()) if problem]
    if problems:
        raise ValidationError(problems)


def layout_problems(given: Mapping[str, Any], schema: BenchSchema) -> list[str]:
    """Return a sentence for each object or factor of a layout that this simulated bench does not have, or not so.

    Places outside its area are allowed: people may lay out the same position on a real bench.
    """
    laid = simulated_bench(given) or {}
    places = [_place_problem(key, value, schema) for key, value in laid.items()]
    factors, choices = given.get("factors"), given.get("choices")
    odd = schema.factor_problems(factors) if isinstance(factors, Mapping) else ()
    other = schema.choice_problems(choices) if isinstance(choices, Mapping) else ()
    return [problem for problem in (*places, *odd, *other) if problem]


def example_layout(schema: BenchSchema) -> dict[str, Any]:
    """Return a layout with every object of a simulated bench at the place that its schema proposes, and its usual
    choices.
    """
    usual = {name: choice.usual for name, choice in schema.choices.items()}
    laid = {name: list(thing.example) for name, thing in schema.objects.items()}
    return laid | ({"choices": usual} if usual else {})


def simulated_bench(given: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """Return the part of a position's layout that a simulated bench can reset itself."""
    return None if given is None else {key: at for key, at in given.items() if key not in _OTHER_KEYS}


def _object_problem(name: object, value: object) -> str:
    if not isinstance(name, str) or not _OBJECT_NAME.fullmatch(name):
        return _sentence(name, "a name of an object of 1 to 40 letters, digits, blanks and _-.")
    problem = _numbers_problem(name, value, _OBJECT)
    if not problem and not all(_SMALLEST <= side <= _LARGEST for side in value[3:]):  # type: ignore[index]
        return _sentence(value, f"width and depth from {_SMALLEST} to {_LARGEST} metres", name)
    return problem


def _place_problem(key: str, value: object, schema: BenchSchema) -> str:
    if key not in schema.objects:
        return f"{key}: unknown key; allowed: {', '.join((*schema.objects, *_OTHER_KEYS))}"
    return _numbers_problem(key, value, schema.objects[key].numbers)


def _numbers_problem(key: str, value: object, parts: Sequence[str]) -> str:
    numbers = isinstance(value, list) and all(_is_number(part) for part in value)
    if not numbers or len(value) != len(parts):  # type: ignore[arg-type]
        return _sentence(value, f"{len(parts)} numbers: [{', '.join(parts)}], x and y in metres", key)
    if max(map(abs, value[:2])) > 2:  # type: ignore[index]
        return _sentence(value, "x and y in metres, at most 2 from the middle", key)
    return ""


def _is_number(value: object) -> bool:
    return is_place([value], 1)


def _problems(value: Mapping[str, Any], config: type[pydantic.BaseModel]) -> list[str]:
    """Return the errors of the table `value`; `config` is the model class of this kind of table.

    Missing keys are no errors, because the deployment supplies their values.
    """
    kind = config.model_fields["kind"].default
    try:
        config.model_validate({**value, "kind": kind})
    except pydantic.ValidationError as invalid:
        errors = [error for error in invalid.errors() if error["type"] != "missing"]
        return [_problem(error, config, kind) for error in errors]
    return []


def _matching_keys(value: Mapping[str, Any], config: type[pydantic.BaseModel]) -> tuple[int, int]:
    """Return how well `value` fits the kind of table that `config` models, as a pair for sorting.

    The first number is that of keys of `value` that resemble a key of that kind; the second, which breaks ties, is the
    number of the kind's keys.
    """
    near = [key for key in value if get_close_matches(str(key), config.model_fields, n=1)]
    return len(near), len(config.model_fields)


def _problem(error: Any, config: type[pydantic.BaseModel], kind: str) -> str:
    key = ".".join(map(str, error["loc"])) or "policy"
    if error["type"] == "extra_forbidden":
        table = _table(config, error["loc"][:-1])
        return f"{key}: unknown key for kind {kind!r}; allowed: {', '.join(table.model_fields)}"
    if error["type"] == "secret":  # keep the value out of pages and logs
        return f"{key}: {error['msg']}"
    return f"{key} = {error['input']!r:.80}: {error['msg'].removeprefix('Value error, ')}"


def _table(config: type[pydantic.BaseModel], path: tuple[str | int, ...]) -> type[pydantic.BaseModel]:
    """Return the model of the nested table at the `path` of keys."""
    for key in path:
        field = config.model_fields.get(str(key))
        parts = (field.annotation, *get_args(field.annotation)) if field else ()
        within = [part for part in parts if isinstance(part, type) and issubclass(part, pydantic.BaseModel)]
        config = within[0] if within else config
    return config


@cache
def _kinds() -> dict[str, type[pydantic.BaseModel]]:
    kinds = {config.model_fields["kind"].default: config for config in policy_tables()}
    # A checkpoint needs a policy, and one that is there without a program that drives by hand.
    return {kind: config for kind, config in kinds.items() if kind not in ("none", "external")}


@cache
def _strategies() -> dict[str, type[pydantic.BaseModel]]:
    return {config.model_fields["kind"].default: config for config in strategy_tables()}


def _sentence(value: object, allowed: str, name: str = "") -> str:
    return f"{name}{' = ' if name else ''}{value!r:.80}; allowed: {allowed}"
