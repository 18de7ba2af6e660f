"""Modality configuration of a GR00T server: the inputs and outputs of its model, in the forms of three versions."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from runtime.core.errors import WrongProtocolError

Name = Literal["video", "state", "action", "language"]
_MOST_ROWS = 10_000  # most rows of a response that a server may announce
_NAMES: tuple[Name, ...] = ("video", "state", "action", "language")
_NEWEST = (
    "__ModalityConfig__"  # mark of N1.7; all its servers read MNP, those of its early access nothing else
)
_MARKS = (_NEWEST, "__ModalityConfig_class__")
_FIELDS = ("as_json", "modality_keys")  # keys of a configuration without a mark
_PLAIN = ("state_keys", "action_keys")  # keys of a server without configurations


@dataclass(frozen=True, slots=True)
class ActionFormat:
    """Format of one action of the model, as servers since GR00T N1.6 declare it."""

    representation: str  # "ABSOLUTE", "DELTA" or "RELATIVE", whose responses are absolute, too
    format: str  # "DEFAULT", "XYZ_ROT6D", "XYZ_ROTVEC"


@dataclass(frozen=True, slots=True)
class Modality:
    """Keys of one modality, without their prefix, and their time steps relative to the newest observation.

    `keys` is None if the server does not list them. `written` maps keys of actions to their formats, and `widths` maps
    keys to their numbers of values; both have only the keys for which the server states this.
    """

    keys: tuple[str, ...] | None = ()
    steps: tuple[int, ...] = (0,)
    written: Mapping[str, ActionFormat] = field(default_factory=dict)
    widths: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Modalities:
    """Modalities of a server: the keys of its model's inputs and outputs.

    `is_n15` is True for version N1.5. `reads_mnp` is True if the server reads the array format MNP, as N1.7 does, None
    if its response does not show the version. `contract` is the whole response of a server that uses this protocol
    without modality configurations (StarVLA), None for other servers.
    """

    video: Modality
    state: Modality
    action: Modality
    language: Modality
    is_n15: bool = False
    reads_mnp: bool | None = None
    contract: Mapping[str, Any] | None = None

    def to_dict(self) -> dict[str, object]:
        """Return the modalities as they are written to a recording's manifest."""
        if self.contract is not None:
            return dict(self.contract)
        by_name = {name: getattr(self, name) for name in _NAMES}
        return {
            name: {"keys": list(modality.keys or ()), "steps": list(modality.steps)}
            for name, modality in by_name.items()
        }


def parse_modalities(reply: object) -> Modalities:
    """Parse the response to get_modality_config; a missing modality has no keys.

    Flat lists of keys, as StarVLA's servers with this protocol have, are accepted, too. Raises PolicyError for an
    invalid response.
    """
    if isinstance(reply, Mapping) and any(name in reply for name in _PLAIN):
        return _contract(reply)
    if not isinstance(reply, Mapping) or not any(name in reply for name in _NAMES):
        raise WrongProtocolError(
            f"the answer to get_modality_config is {_short(reply)}; expected a map of {', '.join(_NAMES)}"
        )
    fields = {name: _marked(reply[name], name) for name in _NAMES if name in reply}
    video, state, action, language = (
        _modality(fields[name], name) if name in fields else Modality() for name in _NAMES
    )
    newest = any(_NEWEST in entry for entry in fields.values())
    texts = any(isinstance(entry.get("as_json"), str) for entry in fields.values())  # the form of N1.5
    marked = any(mark in entry for entry in fields.values() for mark in _MARKS)
    return Modalities(video, state, action, language, texts and not newest, newest if marked else None)


def _contract(contract: Mapping[str, Any]) -> Modalities:
    """Return the modalities of a server that answers with flat lists of keys (StarVLA).

    `contract` is that answer. For everything that it does not state, the deployment's declarations are used.
    """
    horizon: Any = contract.get("action_horizon")
    rows = horizon if type(horizon) is int and 0 < horizon <= _MOST_ROWS else 1
    return Modalities(
        Modality(_flat(contract, "video")),
        Modality(_flat(contract, "state"), widths=_widths(contract, "state")),
        Modality(_flat(contract, "action"), tuple(range(rows)), widths=_widths(contract, "action")),
        Modality(None),
        contract=contract,
    )


def _flat(contract: Mapping[str, Any], name: Name) -> tuple[str, ...] | None:
    """Return the keys of a modality without their prefix; None if the contract lists no keys for it."""
    keys = contract.get(f"{name}_keys", [])
    if not isinstance(keys, list) or not all(isinstance(key, str) for key in keys):
        raise WrongProtocolError(f"the server has {name}_keys {_short(keys)}; expected a list of names")
    return tuple(key.removeprefix(f"{name}.") for key in keys) or None


def _widths(contract: Mapping[str, Any], name: Name) -> dict[str, int]:
    widths = contract.get(f"{name}_key_dims", {})
    if not isinstance(widths, Mapping) or not all(type(width) is int for width in widths.values()):
        raise WrongProtocolError(
            f"the server has {name}_key_dims {_short(widths)}; expected a number by name"
        )
    return {str(key).removeprefix(f"{name}."): width for key, width in widths.items()}


def _marked(value: Any, name: Name) -> Mapping[str, Any]:
    if not isinstance(value, Mapping) or not any(key in value for key in (*_MARKS, *_FIELDS)):
        raise WrongProtocolError(
            f"the server's modality {name!r} is {_short(value)}; expected a modality configuration"
        )
    return value


def _modality(entry: Mapping[str, Any], name: Name) -> Modality:
    fields = entry.get("as_json", entry)
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
    """Return the format of each action key; {} unless `configs` is a list with one entry per key.

    A list of another length is no error, because some servers send one and work.
    """
    if not isinstance(configs, list) or len(configs) != len(keys):
        return {}
    return {
        key: ActionFormat(_enum_name(config.get("rep")), _enum_name(config.get("format")))
        for key, config in zip(keys, configs, strict=True)
        if isinstance(config, Mapping)
    }


def _enum_name(value: object) -> str:
    """Return the name of an enumeration member, in capitals.

    Servers send either the member's name or its value, which differ in spelling.
    """
    return str(value).upper().replace("+", "_")


def join_names(names: Iterable[str]) -> str:
    """Return the names as one text for a message, "none" if there are none."""
    return ", ".join(names) or "none"


def _short(value: object) -> str:
    return f"{type(value).__name__} {str(value)[:80]!r}"
