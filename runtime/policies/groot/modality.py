"""What a GR00T server says that it is shown and answers: its modality configuration, in the forms of three versions."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from runtime.errors import WrongProtocolError

Name = Literal["video", "state", "action", "language"]
_NAMES: tuple[Name, ...] = ("video", "state", "action", "language")
_MARKS = ("__ModalityConfig__", "__ModalityConfig_class__")


@dataclass(frozen=True, slots=True)
class Written:
    """How N1.6 and newer write an action."""

    representation: str  # "ABSOLUTE", "DELTA", "RELATIVE", which it answers as absolute
    format: str  # "DEFAULT", "XYZ_ROT6D", "XYZ_ROTVEC"


@dataclass(frozen=True, slots=True)
class Modality:
    """Keys without their prefix, and the steps that each stands for, relative to the newest observation.

    `written` says of actions how they are, by key, as far as the server does.
    """

    keys: tuple[str, ...] = ()
    steps: tuple[int, ...] = (0,)
    written: Mapping[str, Written] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Modalities:
    """All four; `early` where the server is of version N1.5."""

    video: Modality
    state: Modality
    action: Modality
    language: Modality
    early: bool

    def plain(self) -> dict[str, object]:
        """For a recording's manifest."""
        each = {name: getattr(self, name) for name in _NAMES}
        return {name: {"keys": list(one.keys), "steps": list(one.steps)} for name, one in each.items()}


def modalities(reply: object) -> Modalities:
    """The answer to get_modality_config; PolicyError where it is none. A modality that is not in it has no keys."""
    if not isinstance(reply, Mapping) or not any(name in reply for name in _NAMES):
        raise WrongProtocolError(
            f"the answer to get_modality_config is {_short(reply)}; expected a map of {', '.join(_NAMES)}"
        )
    early = [_is_early(reply[name], name) for name in _NAMES if name in reply]
    found = {name: _modality(reply[name], name) if name in reply else Modality() for name in _NAMES}
    return Modalities(**found, early=any(early))


def _is_early(given: Any, name: Name) -> bool:
    """N1.5 writes the fields as JSON text."""
    if not isinstance(given, Mapping) or not any(mark in given for mark in _MARKS):
        raise WrongProtocolError(
            f"the server's modality {name!r} is {_short(given)}; expected a modality configuration"
        )
    return isinstance(given.get("as_json"), str)


def _modality(given: Mapping[str, Any], name: Name) -> Modality:
    fields = given.get("as_json")
    if isinstance(fields, str):
        try:
            fields = json.loads(fields)
        except (ValueError, RecursionError) as error:
            raise WrongProtocolError(f"the server's modality {name!r} is no JSON: {error}") from error
    if not isinstance(fields, Mapping):
        raise WrongProtocolError(
            f"the server's modality {name!r} has as_json {_short(fields)}; expected a map"
        )
    keys, steps = fields.get("modality_keys"), fields.get("delta_indices")
    if not isinstance(keys, list) or not all(isinstance(key, str) for key in keys):
        raise WrongProtocolError(
            f"the server's modality {name!r} has modality_keys {_short(keys)}; expected names"
        )
    if not isinstance(steps, list) or not steps or not all(type(step) is int for step in steps):
        raise WrongProtocolError(
            f"the server's modality {name!r} has delta_indices {_short(steps)}; expected integers"
        )
    bare = tuple(key.removeprefix(f"{name}.") for key in keys)
    return Modality(bare, tuple(steps), _written(bare, fields.get("action_configs")))


def _written(keys: tuple[str, ...], configs: object) -> dict[str, Written]:
    """By key; nothing where there is not one for each, which some servers get wrong without harm."""
    if not isinstance(configs, list) or len(configs) != len(keys):
        return {}
    return {
        key: Written(_word(config.get("rep")), _word(config.get("format")))
        for key, config in zip(keys, configs, strict=True)
        if isinstance(config, Mapping)
    }


def _word(given: object) -> str:
    """An enumeration's name, of its name or of its value."""
    return str(given).upper().replace("+", "_")


def listed(names: Iterable[str]) -> str:
    """Names for a sentence."""
    return ", ".join(names) or "none"


def _short(value: object) -> str:
    return f"{type(value).__name__} {str(value)[:80]!r}"
