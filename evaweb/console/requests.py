"""Requests of a page over the live socket, validated before use."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any
from uuid import UUID, uuid4

from evaweb.core.errors import EvaError
from runtime.core import bounded_documents as bounded
from runtime.core.sentences import Pattern
from runtime.ipc import estop_requests as pressing

_TYPE_UNKNOWN_ALLOWED_WATCH_ESTOP = Pattern(
    "console.requests.type_unknown_allowed_watch_estop",
    "type {kind!r:.40} is unknown; allowed: watch, estop, {read}",
)
_STREAMS_ALLOWED_LIST = Pattern(
    "console.requests.streams_allowed_list",
    "streams = {streams!r:.200}; allowed: a list of {allowed}",
)
_ALLOWED_WHOLE_NUMBER_FROM_0 = Pattern(
    "console.requests.allowed_whole_number_from_0",
    "{key} = {value!r:.40}; allowed: a whole number from 0 on",
)
_ALLOWED_MAP = Pattern("console.requests.allowed_map", "{key} = {value!r:.40}; allowed: a map")
_ALLOWED_TEXT = Pattern("console.requests.allowed_text", "{key} = {value!r:.40}; allowed: a text")

_LARGEST = 64 * 1024  # [characters] limit of a message other than an e-stop press
STREAMS = ("state", "joints", "recent", "poses", "chunk")
PAGE = re.compile(r"[A-Za-z0-9_-]{1,64}")
_MOST_VALUES = 1000  # values per message
_LONGEST_STOP = 4096  # [characters] limit of a stop or halt from a page that floods


class BadRequest(EvaError):
    """Error for an invalid message of a page; the text names the given and the allowed values."""


@dataclass(frozen=True, slots=True)
class Watch:
    """Request of a page to be sent these streams from now on."""

    streams: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Credit:
    """Message of a page that it has drawn a frame."""


@dataclass(frozen=True, slots=True)
class Renew:
    """Heartbeat of the page that holds the lease of this epoch; `hidden` is True if its browser tab is hidden."""

    epoch: int
    hidden: bool = False


@dataclass(frozen=True, slots=True)
class EStop:
    """E-stop press of a page."""

    uuid: UUID
    why: str


@dataclass(frozen=True, slots=True)
class Stop:
    """Stop or halt of a page, under the lease of this epoch."""

    kind: str
    uuid: UUID
    epoch: int


@dataclass(frozen=True, slots=True)
class Events:
    """Request for the station's events with a number above `after`.

    `boot` is the boot of the runtime that numbered the events, "" for the current boot. If the runtime has started anew
    since that boot, all events are requested.
    """

    after: int
    boot: str


@dataclass(frozen=True, slots=True)
class Aim:
    """Query about a target, with the arguments of the runtime's `aim`; the answer carries the page's own `id`."""

    id: int
    args: Mapping[str, Any]


Request = Watch | Credit | Renew | EStop | Stop | Events | Aim


def may_be_stop(text: str) -> bool:
    """Return True if a message of a page may stop a robot.

    A message that cannot be parsed completely may count as a stop too.
    """
    if pressing.parse_json_press(text, "type") is not None:
        return True
    return len(text) <= _LONGEST_STOP and any(f'"{kind}"' in text for kind in ("stop", "halt"))


def parse(text: str, cameras: Collection[str]) -> Request:
    """Return the request in a text message.

    Raises:
        BadRequest: If it is not valid.
    """
    press = pressing.parse_json_press(text, "type")
    if press is not None:  # a press is accepted whatever else the message contains
        return EStop(_uuid(press), pressing.json_reason(press))
    try:
        message = bounded.parse_json(text, "the message", _LARGEST, _MOST_VALUES)
    except bounded.UnreadableDocument as error:
        raise BadRequest(f"{error} (given: {text!r:.60})") from None
    kind = message.get("type") if isinstance(message, dict) else None
    if kind == "watch":
        return Watch(_streams(message, cameras))
    read = _READ.get(kind) if isinstance(kind, str) else None
    if read is None:
        raise BadRequest(_TYPE_UNKNOWN_ALLOWED_WATCH_ESTOP(kind=kind, read=", ".join(_READ)))
    return read(message)


def _streams(message: Mapping[str, Any], cameras: Collection[str]) -> tuple[str, ...]:
    allowed = (*STREAMS, *(f"camera/{camera}" for camera in cameras))
    streams = message.get("streams")
    if not isinstance(streams, list) or any(stream not in allowed for stream in streams):
        raise BadRequest(_STREAMS_ALLOWED_LIST(streams=streams, allowed=", ".join(allowed)))
    return tuple(streams)


def _int_field(message: Mapping[str, Any], key: str) -> int:
    value = message.get(key)
    if type(value) is not int or not 0 <= value <= 2**53:
        raise BadRequest(_ALLOWED_WHOLE_NUMBER_FROM_0(key=key, value=value))
    return value


def _map(message: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    value = message.get(key)
    if not isinstance(value, dict):
        raise BadRequest(_ALLOWED_MAP(key=key, value=value))
    return value


def _text(message: Mapping[str, Any], key: str, default: str) -> str:
    value = message.get(key) or default
    if not isinstance(value, str):
        raise BadRequest(_ALLOWED_TEXT(key=key, value=value))
    return value


def _stop(kind: str) -> Callable[[Mapping[str, Any]], Stop]:
    return lambda said: Stop(kind, _uuid(said), _int_field(said, "epoch"))


def _uuid(message: Mapping[str, Any]) -> UUID:
    """Return the uuid in the request, by which the page recognises the answer; a new uuid if it has no valid one."""
    try:
        return UUID(str(message.get("uuid")))
    except ValueError:
        return uuid4()


_READ: dict[str, Callable[[Mapping[str, Any]], Request]] = {
    "credit": lambda said: Credit(),
    "renew": lambda said: Renew(_int_field(said, "epoch"), said.get("hidden") is True),
    "stop": _stop("stop"),
    "halt": _stop("halt"),
    "events": lambda said: Events(_int_field(said, "after"), _text(said, "boot", "")),
    "aim": lambda said: Aim(_int_field(said, "id"), _map(said, "args")),
}
