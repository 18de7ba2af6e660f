"""Message of a script: one frame of JSON, whose form is checked before anything is executed."""

from __future__ import annotations

import json
import re
import uuid
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, NoReturn

from runtime.core.errors import RuntimeFault
from runtime.ipc import estop_requests as pressing

LARGEST = 64 * 1024  # bytes of one message
_PREFIX = "web:"
_LONGEST_NAME = 80  # characters of a press's name that are repeated in the answer
_CLIENT = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,62}")
_OWN_KEYS = ("command", "arguments", "client", "id")


class Malformed(RuntimeFault):
    """Error about a message that cannot be read; its text is returned to the script."""


@dataclass(frozen=True, slots=True)
class Message:
    """Request of a script: a query, a `cmd` of the older channel (`name` is its verb), or a `command` of EVA Web.

    `argument` is the text after the verb's colon, None without a colon. `client` is the name that the script gives
    itself, "" if none. `fields` is the message as received.
    """

    form: Literal["query", "cmd", "command"]
    name: str
    fields: Mapping[str, Any]
    argument: str | None = None
    arguments: Mapping[str, Any] = field(default_factory=dict)
    client: str = ""
    id: str = ""

    @property
    def echo(self) -> dict[str, Any]:
        """Part of the message that its answer repeats."""
        return {} if self.form == "query" else {self.form: self.fields[self.form]}


def read(frames: list[bytes]) -> Message:
    """Parse a message from its frames, without the sender's address.

    Raises: Malformed if the message is invalid. A press of the e-stop is always accepted, whatever else is invalid.
    """
    for frame in frames:
        if (press := pressing.parse_json_press(frame, "command", "cmd")) is not None:
            return _press(press)
    fields = _object(frames)
    client, identity = _client(fields), _identity(fields)
    if "query" in fields:
        return Message("query", _text_field(fields, "query"), fields, client=client, id=identity)
    if "cmd" in fields:
        verb, argument = _verb(fields["cmd"])
        return Message("cmd", verb, fields, argument, client=client, id=identity)
    if "command" in fields:
        arguments = _arguments(fields)
        return Message(
            "command", _text_field(fields, "command"), fields, arguments=arguments, client=client, id=identity
        )
    raise Malformed("message must carry 'cmd' or 'query' (or 'command')")


def _press(message: Mapping[str, Any]) -> Message:
    """Return the e-stop press in `message`.

    Invalid fields of the message are ignored. The `arguments` of the result contain the reason of the press.
    """
    form: Literal["cmd", "command"] = "cmd" if isinstance(message.get("cmd"), str) else "command"
    word = message.get(form)
    named = word if isinstance(word, str) else pressing.NAME
    reason = named.partition(f"{pressing.NAME}:")[2] or "over the control channel"
    arguments = {"why": pressing.json_reason(message, pressing.sanitize_text(reason))}
    fields: dict[str, Any] = {form: named[:_LONGEST_NAME]}
    client, identity = _or_none(_client, message), _or_none(_identity, message)
    return Message(form, pressing.NAME, fields, None, arguments, client, identity)


def _or_none(read: Callable[[Mapping[str, Any]], str], fields: Mapping[str, Any]) -> str:
    try:
        return read(fields)
    except Malformed:
        return ""


def _object(frames: list[bytes]) -> dict[str, Any]:
    if len(frames) != 1:
        raise Malformed(f"recv failed: a message is one frame of JSON, and {len(frames)} came")
    if len(frames[0]) > LARGEST:
        raise Malformed(f"recv failed: {len(frames[0])} bytes; allowed: at most {LARGEST}")
    try:
        parsed = json.loads(frames[0].decode("utf-8"), parse_constant=_no_number)
    except (ValueError, RecursionError) as error:  # JSON and UTF-8 alike
        raise Malformed(f"recv failed: not JSON in UTF-8: {error}") from None
    if not isinstance(parsed, dict):
        raise Malformed("message must be a JSON object")
    return parsed


def _no_number(word: str) -> NoReturn:
    raise ValueError(f"{word} is no number of JSON")


def _text_field(fields: Mapping[str, Any], key: str) -> str:
    word: object = fields[key]
    if not isinstance(word, str):
        raise Malformed(f"unknown {key}: {word!r:.80}; it is a word")
    return word


def _verb(text: object) -> tuple[str, str | None]:
    if not isinstance(text, str) or not text.startswith(_PREFIX):
        raise Malformed(f"command must start with 'web:', got {text!r:.80}")
    verb, colon, argument = text.removeprefix(_PREFIX).partition(":")
    return verb, argument if colon else None


def _arguments(fields: Mapping[str, Any]) -> dict[str, Any]:
    unknown = [key for key in fields if key not in _OWN_KEYS]
    if unknown:
        raise Malformed(f"{unknown[0]!r:.80} is no key of a command; allowed: {', '.join(_OWN_KEYS)}")
    arguments = fields.get("arguments", {})
    if not isinstance(arguments, dict):
        raise Malformed(f"arguments = {arguments!r:.80}: must be a JSON object")
    return arguments


def _client(fields: Mapping[str, Any]) -> str:
    client: object = fields.get("client", "")
    if isinstance(client, str) and (not client or _CLIENT.fullmatch(client)):
        return client
    raise Malformed(
        f"client = {client!r:.80}: must be a name of at most 63 letters, digits, dots, dashes, underscores"
    )


def _identity(fields: Mapping[str, Any]) -> str:
    """Return the id of the message, a UUID; "" if it has none.

    A command that is repeated under the same id gets the answer to its first execution. Other names are refused as ids,
    because two scripts could use the same name by accident.
    """
    value = fields.get("id", "")
    if value == "":
        return ""
    try:
        return str(uuid.UUID(value))
    except (ValueError, TypeError, AttributeError):
        raise Malformed(f"id = {value!r:.80}: must be a UUID, or absent") from None
