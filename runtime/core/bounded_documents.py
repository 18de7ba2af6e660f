"""Parsing of untrusted TOML and JSON, after a check of length, depth and number of values.

The cost of parsing grows with the square of the depth, or with the stack: 20,000 nested TOML tables take a minute and
gigabytes. Later stages pay for each value: a list of three characters takes 60 bytes and is visited a dozen times.
"""

from __future__ import annotations

import json
import re
import stat
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

MAX_BYTES = 2_000_000  # [characters]
MAX_DEPTH = 40  # nested tables and lists
MAX_ITEMS = 100_000  # values, counted by brackets, commas and the = of keys

_JSON = re.compile(r'"(?:[^"\\]++|\\.)*+"?|[\[\]{},]', re.DOTALL)
_TOML = re.compile(
    r'"""(?:[^"\\]++|\\.|"(?!""))*+(?:"{3,5}+)?'  # up to two of the quotes at the end belong to the string
    r"|'''(?:[^']++|'(?!''))*+(?:'{3,5}+)?"
    r'|"(?:[^"\\\n]++|\\.)*+"?'
    r"|'[^'\n]*+'?"
    r"|\#[^\n]*+"
    r"|[\[\]{}.=,\n]",
    re.DOTALL,
)


class UnreadableDocument(ValueError):
    """Error about a document that cannot be read; the message names it, the reason and what is allowed."""


def parse_toml(text: str, what: str, largest: int = MAX_BYTES) -> dict[str, Any]:
    """Parse a TOML text and return its table.

    `what` names the document in error messages; `largest` is the largest permitted size of the text.

    Raises:
        UnreadableDocument: the text is too large, too deep or invalid TOML; the message contains `what`.
    """
    _require_small(text, what, largest)
    _require_flat(text, what, _TOML)
    document: dict[str, Any] = _parsed(tomllib.loads, text, what, "TOML")
    return document


def load_toml(path: Path, what: str) -> dict[str, Any]:
    """Return the table in a TOML file.

    `what` is the name of the file in messages.

    Raises:
        UnreadableDocument: the file is no regular file, or its text is too large, too deep or invalid.
        OSError: the file cannot be read.
    """
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):
        raise UnreadableDocument(f"{what}: is no file")
    if status.st_size > MAX_BYTES:
        raise UnreadableDocument(f"{what}: {status.st_size} bytes; allowed: at most {MAX_BYTES}")
    try:
        return parse_toml(path.read_text("utf-8"), what)
    except UnicodeDecodeError as error:
        raise UnreadableDocument(f"{what}: is not valid TOML: {error}") from None


def parse_json(text: str | bytes, what: str, largest: int = MAX_BYTES, most: int = MAX_ITEMS) -> Any:
    """Return the value in `text`.

    Raises:
        UnreadableDocument: the text is too large, too deep, has too many values or is invalid; `what` names it.
    """
    _require_small(text, what, largest)
    try:
        text = text if isinstance(text, str) else text.decode("utf-8")
    except UnicodeDecodeError as error:
        raise UnreadableDocument(f"{what}: is not valid JSON: {error}") from None
    _require_flat(text, what, _JSON, most)
    return _parsed(json.loads, text, what, "JSON")


def _parsed(parse: Callable[[str], Any], text: str, what: str, language: str) -> Any:
    try:
        return parse(text)
    except ValueError as error:  # also Python's limit on the digits of an integer
        raise UnreadableDocument(f"{what}: is not valid {language}: {error}") from None


def _require_small(text: str | bytes, what: str, largest: int) -> None:
    if len(text) > largest:
        raise UnreadableDocument(f"{what}: {len(text)} characters; allowed: at most {largest}")


def _require_flat(text: str, what: str, marks: re.Pattern[str], most: int = MAX_ITEMS) -> None:
    """Raise UnreadableDocument if the nesting or the number of values exceeds its limit.

    The nesting is estimated from brackets and the dots of keys outside strings, values from brackets, commas and "=".
    The estimate of the nesting is never lower than the number of levels that a parser would create.
    """
    depth = dots = values = 0
    for mark in marks.finditer(text):
        word = mark[0]
        values += word in "[{,="
        if values > most:
            raise UnreadableDocument(f"{what}: more than {most} values; allowed: at most {most}")
        if word in "[{":
            depth, dots = depth + 1, 0
        elif word in "]}":
            depth = max(0, depth - 1)
            dots = 0
        elif word == ".":
            dots += 1
        elif word in "=,\n":
            dots = 0
        if depth + dots > MAX_DEPTH:
            line = text.count("\n", 0, mark.start()) + 1
            raise UnreadableDocument(
                f"{what}: line {line} has more than {MAX_DEPTH} tables or lists within each other; allowed: at most "
                f"{MAX_DEPTH}"
            )
