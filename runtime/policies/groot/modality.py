"""A GR00T server's modality configuration, in the forms of three versions: its inputs and its answers."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from runtime.core.errors import WrongProtocolError

Name = Literal["video", "state", "action", "language"]
_MOST_ROWS = 10_000  # of an answer that a server announces
_NAMES: tuple[Name, ...] = ("video", "state", "action", "language")
_NEWEST = (
    "__ModalityConfig__"  # N1.7's; all of its servers read MNP, and those of its early access nothing else
)
_MARKS = (_NEWEST, "__ModalityConfig_class__")
_FIELDS = ("as_json", "modality_keys")  # of a configuration that has no mark
_PLAIN = ("state_keys", "action_keys")  # of a server without configurations


@dataclass(frozen=True, slots=True)
class ActionFormat:
    """Format of an action in N1.6 and newer."""

    representation: str  # "ABSOLUTE", "DELTA", "RELATIVE", which it answers as absolute
    format: str  # "DEFAULT", "XYZ_ROT6D", "XYZ_ROTVEC"


@dataclass(frozen=True, slots=True)
class Modality:
    """Keys without their prefix, and the steps that each stands for, relative to the newest observation.

    `keys` is None where the server does not say which it has. `written` says of actions how they are, `widths` of
    how many numbers, by key, as far as the server does.
    """

    keys: tuple[str, ...] | None = ()
    steps: tuple[int, ...] = (0,)
    written: Mapping[str, ActionFormat] = field(default_factory=dict)
    widths: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Modalities:
    """All four; `is_n15` where the server is of version N1.5, `reads_mnp` where it reads arrays as N1.7 does.

    `reads_mnp` is None where its answer has the mark of no version.

    `contract` is the answer of a server that speaks the protocol and has no modality configurations.
    """

    video: Modality
    state: Modality
    action: Modality
    language: Modality
    is_n15: bool = False
    reads_mnp: bool | None = None
    contract: Mapping[str, Any] | None = None

    def to_dict(self) -> dict[str, object]:
        """For a recording's manifest."""
        if self.contract is not None:
            return dict(self.contract)
        each = {name: getattr(self, name) for name in _NAMES}
        return {name: {"keys": list(one.keys or ()), "steps": list(one.steps)} for name, one in each.items()}


def parse_modalities(reply: object) -> Modalities:
    """The answer to get_modality_config; PolicyError where it is none. A modality that is not in it has no keys.

    StarVLA's servers of this protocol have flat lists of keys instead.
    """
    if isinstance(reply, Mapping) and any(name in reply for name in _PLAIN):
        return _contract(reply)
    if not isinstance(reply, Mapping) or not any(name in reply for name in _NAMES):
        raise WrongProtocolError(
            f"the answer to get_modality_config is {_short(reply)}; expected a map of {', '.join(_NAMES)}"
        )
    given = {name: _marked(reply[name], name) for name in _NAMES if name in reply}
    video, state, action, language = (
        _modality(given[name], name) if name in given else Modality() for name in _NAMES
    )
    newest = any(_NEWEST in one for one in given.values())
    texts = any(isinstance(one.get("as_json"), str) for one in given.values())  # as N1.5 writes the fields
    marked = any(mark in one for one in given.values() for mark in _MARKS)
    return Modalities(video, state, action, language, texts and not newest, newest if marked else None)


def _contract(given: Mapping[str, Any]) -> Modalities:
    """Modalities from keys in flat lists; where nothing is said, the deployment's are right."""
    horizon: Any = given.get("action_horizon")
    rows = horizon if type(horizon) is int and 0 < horizon <= _MOST_ROWS else 1
    return Modalities(
        Modality(_flat(given, "video")),
        Modality(_flat(given, "state"), widths=_widths(given, "state")),
        Modality(_flat(given, "action"), tuple(range(rows)), widths=_widths(given, "action")),
        Modality(None),
        contract=given,
    )


def _flat(given: Mapping[str, Any], name: Name) -> tuple[str, ...] | None:
    """A list's keys without their prefix; None where there are none: such a model is not shown that."""
    keys = given.get(f"{name}_keys", [])
    if not isinstance(keys, list) or not all(isinstance(key, str) for key in keys):
        raise WrongProtocolError(f"the server has {name}_keys {_short(keys)}; expected a list of names")
    return tuple(key.removeprefix(f"{name}.") for key in keys) or None


def _widths(given: Mapping[str, Any], name: Name) -> dict[str, int]:
    widths = given.get(f"{name}_key_dims", {})
    if not isinstance(widths, Mapping) or not all(type(width) is int for width in widths.values()):
        raise WrongProtocolError(
            f"the server has {name}_key_dims {_short(widths)}; expected a number by name"
        )
    return {str(key).removeprefix(f"{name}."): width for key, width in widths.items()}


def _marked(given: Any, name: Name) -> Mapping[str, Any]:
    if not isinstance(given, Mapping) or not any(key in given for key in (*_MARKS, *_FIELDS)):
        raise WrongProtocolError(
            f"the server's modality {name!r} is {_short(given)}; expected a modality configuration"
        )
    return given


def _modality(given: Mapping[str, Any], name: Name) -> Modality:
    fields = given.get("as_json", given)
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


def _written(keys: tuple[str, ...], configs: object) -> dict[str, ActionFormat]:
    """By key; nothing where there is not one for each, which some servers get wrong without harm."""
    if not isinstance(configs, list) or len(configs) != len(keys):
        return {}
    return {
        key: ActionFormat(_word(config.get("rep")), _word(config.get("format")))
        for key, config in zip(keys, configs, strict=True)
        if isinstance(config, Mapping)
    }


def _word(given: object) -> str:
    """An enumeration's name, of its name or of its value."""
    return str(given).upper().replace("+", "_")


def join_names(names: Iterable[str]) -> str:
    """Names for a sentence."""
    return ", ".join(names) or "none"


def _short(value: object) -> str:
    return f"{type(value).__name__} {str(value)[:80]!r}"
