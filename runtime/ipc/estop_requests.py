"""Detection of e-stop presses in messages of each wire format, tolerant of errors in the rest of a message.

All entry points use this module alone. A readable message is a press if its kind is "estop"; in an unreadable message,
or one without a kind, a text search decides. Nothing here raises, and each message is scanned in linear time.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any
from uuid import uuid4

import msgpack  # type: ignore[import-untyped]

from runtime.ipc.messages import Command

NAME = "estop"
DEFAULT_REASON = "pressed"  # if no reason is given
LONGEST = 240  # characters of a reason, a name, or a list of defects
_LONGEST_UUID = 64
_TEXTS = ("uuid", "user", "holder", "role")
_READ = frozenset(("kind", "args", *_TEXTS))
_UNREADABLE = (ValueError, TypeError, RecursionError, OverflowError, msgpack.exceptions.UnpackException)
_PACKED = re.compile(rb"kind.{0,8}?estop", re.DOTALL)
_ESCAPED = re.compile(r"\\u([0-9a-fA-F]{4})")
_WORD = re.compile(r"\s*(?:web:)?estop\s*(?::.*)?", re.DOTALL)
_LOOSE = r"""\b(?:%s)["']?\s{0,9}[:=]\s{0,9}["']?\s{0,9}(?:web:)?estop\b"""


def sanitize_text(text: str) -> str:
    """Return the text cut to LONGEST characters, without characters that cannot be sent or stored."""
    return text[:LONGEST].encode("utf-8", "replace").decode().replace("\x00", "")


def reason_of(command: Command) -> str:
    """Return the reason of a press, DEFAULT_REASON if it is missing or no text."""
    reason = command.args.get("why")
    return reason if isinstance(reason, str) and reason else DEFAULT_REASON


# --- the bus: msgpack ----------------------------------------------------------------------------------------


def kind_of(payload: bytes) -> str:
    """Return the first `kind` in a message of the bus, without decoding its arguments; "" if there is none."""
    try:
        return next((_text(value) or "" for key, value in _pairs(payload) if key == "kind"), "")
    except _UNREADABLE:
        return ""


def parse_packed_press(payload: bytes) -> Command | None:
    """Return the press in a message of the bus, from all readable fields; None if the message is no press."""
    if b"estop" not in payload or _PACKED.search(payload) is None:
        return None
    fields: dict[str, bytes] = {}
    kinds, wrong = [], []
    try:
        for key, value in _pairs(payload):
            if key == "kind":
                kinds.append(_text(value))
                if kinds[-1] is None:
                    wrong.append("kind is no text")
            fields[key] = value
    except _UNREADABLE as error:
        wrong.append(f"unreadable: {error or type(error).__name__}")
    if kinds and NAME not in kinds and not wrong:
        return None
    return _press(fields, wrong)


def _press(fields: Mapping[str, bytes], wrong: list[str]) -> Command:
    texts = {key: _text(fields[key]) for key in _TEXTS if key in fields}
    wrong += [f"{key} is no text" for key, text in texts.items() if text is None]
    given = texts.pop("uuid", None) or ""
    if len(given) > _LONGEST_UUID:
        wrong.append(f"uuid has {len(given)} characters")
    uuid = given if 0 < len(given) <= _LONGEST_UUID else str(uuid4())
    reason = _why(fields.get("args"), wrong)
    faults = f" (message: {'; '.join(wrong)})" if wrong else ""
    user, holder, role = (sanitize_text(texts.get(key) or "") for key in ("user", "holder", "role"))
    return Command(uuid, NAME, {"why": sanitize_text(reason) + faults[:LONGEST]}, user, holder, role=role)


def _why(args: bytes | None, wrong: list[str]) -> str:
    if args is None:
        return DEFAULT_REASON
    try:
        values = [value for key, value in _pairs(args, ("why",)) if key == "why"]
    except _UNREADABLE:
        wrong.append("args is no map")
        return DEFAULT_REASON
    reason = _text(values[-1]) if values else DEFAULT_REASON
    if reason is None:
        wrong.append("why is no text")
    return reason or DEFAULT_REASON


def _pairs(packed: bytes, wanted: frozenset[str] | tuple[str, ...] = _READ) -> Iterator[tuple[str, bytes]]:
    """Yield the `wanted` keys of the outermost map in `packed` with their encoded values; nothing else is decoded.

    Raises an error of _UNREADABLE if `packed` is no map, is incomplete, or is followed by further bytes.
    """
    reader = msgpack.Unpacker(raw=True)
    reader.feed(packed)
    for _ in range(reader.read_map_header()):
        begin = reader.tell()
        reader.skip()
        middle = reader.tell()
        reader.skip()
        key = _text(packed[begin:middle])
        if key is not None and key in wanted:
            yield key, packed[middle : reader.tell()]
    if reader.tell() != len(packed):
        raise ValueError(f"{len(packed) - reader.tell()} bytes follow it")


def _text(packed: bytes) -> str | None:
    """Return encoded text or bytes as a text; None for another type."""
    if len(packed) > 1 << 20 or not packed or not _is_text(packed[0]):
        return None
    value: bytes = msgpack.unpackb(packed, raw=True)
    return value.decode("utf-8", "replace")


def _is_text(mark: int) -> bool:
    return 0xA0 <= mark <= 0xBF or 0xD9 <= mark <= 0xDB or 0xC4 <= mark <= 0xC6


# --- pages, REST and scripts: JSON ---------------------------------------------------------------------------


class _Table(list[tuple[str, Any]]):
    """JSON object as a list of pairs, so that duplicate keys are preserved."""


_JSON = json.JSONDecoder(object_pairs_hook=_Table)
_READ_WHOLE, _WINDOW = 8192, 4096  # characters


def parse_json_press(said: str | bytes, *keys: str) -> dict[str, Any] | None:
    """Return the fields of a press in JSON, {} if they cannot be read; None if the message is no press.

    A message is a press if its kind is "estop", "web:estop" or "estop:REASON". `keys` are the names under which a
    message may have its kind, for example "type". A message much longer than a press is searched only at its beginning
    and its end.
    """
    text = said if isinstance(said, str) else said.decode(json.detect_encoding(said), "replace")
    text = text.lstrip("\ufeff \t\r\n")
    if NAME not in text and "\\u" not in text:
        return None
    if len(text) > _READ_WHOLE:  # a large message must not delay other clients' presses
        parts = (text[:_WINDOW], text[-_WINDOW:])
        return _fields(parts) if any(_loosely(part, keys) for part in parts) else None
    try:
        message, end = _JSON.raw_decode(text)
    except (ValueError, RecursionError):
        message, end = None, 0
    if isinstance(message, _Table):
        named = [value for key, value in message if key in keys]
        if any(isinstance(value, str) and _WORD.fullmatch(value) for value in named):
            return {key: _plain(value) for key, value in message}
        if named and not text[end:].strip():
            return None
    return {} if _loosely(text, keys) else None


def _fields(parts: Sequence[str]) -> dict[str, Any]:
    """Return uuid and reason of a long e-stop press, as far as they are found.

    `parts` are the beginning and the end of the message. A value in the beginning has precedence over one in the end.
    """
    pattern = r'"%s"\s{0,9}:\s{0,9}"([^"\\]{1,240})'
    matches = ((key, re.search(pattern % key, part)) for part in reversed(parts) for key in ("uuid", "why"))
    return {key: match[1] for key, match in matches if match}


def _loosely(text: str, keys: Sequence[str]) -> bool:
    """Return True if the text has one of `keys` with the name of an e-stop press as the value of the key.

    The text need not be valid JSON.
    """
    bare = _ESCAPED.sub(lambda code: chr(int(code[1], 16)), text).replace("\\", "")
    return re.search(_LOOSE % "|".join(keys), bare) is not None


def json_reason(said: Mapping[str, Any], default: str = DEFAULT_REASON) -> str:
    """Return the reason of a press in JSON, from its top level or its arguments; `default` if it has none."""
    args = [said.get(key) for key in ("args", "arguments")]
    for table in (said, *(one for one in args if isinstance(one, dict))):
        if isinstance(reason := table.get("why"), str) and reason:
            return sanitize_text(reason)
    return default


def _plain(value: Any) -> Any:
    return dict(value) if isinstance(value, _Table) else value
