"""Sentences for people, each with an id and arguments, by which it can be translated.

A module declares its sentences as `Pattern`s next to their use, and calls one to create a `Sentence`. That is a `str`,
so logs, records and comparisons use the English text.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from enum import Enum
from math import isfinite
from numbers import Integral, Real
from string import Formatter
from typing import Any, Literal

Argument = str | int | float  # a str may be another Sentence

_ID = re.compile(r"[a-z][a-z0-9_]*(\.[a-z0-9_]+)+")
_NAME = re.compile(r"[a-z][a-z0-9_]{0,39}")
_SPEC = re.compile(r"(\.\d)?[fg]|d|\.\d{1,3}|")  # pages have the same rule: static/site/sentences.js
_LONGEST_ID, _MOST, _DEEPEST = 100, 24, 8
_LARGEST = 2**53

_KNOWN: dict[str, Pattern] = {}  # state: the patterns of the modules that were imported, by id


class Sentence(str):
    """English sentence with `id` and `arguments`; concatenated or formatted it is a plain str."""

    __slots__ = ("arguments", "depth", "id")
    id: str
    arguments: Mapping[str, Argument]
    depth: int  # 1 if no argument is a sentence

    def __new__(cls, text: str, id: str, arguments: Mapping[str, Argument]) -> Sentence:
        sentence = super().__new__(cls, text)
        sentence.id, sentence.arguments = id, arguments
        sentence.depth = 1 + max(
            (of.depth for of in arguments.values() if isinstance(of, Sentence)), default=0
        )
        return sentence

    def __str__(self) -> str:
        return self  # so that str() of an exception is the original Sentence

    def __getnewargs__(self) -> tuple[str, str, Mapping[str, Argument]]:  # type: ignore[override]
        return plain(self), self.id, self.arguments

    def __copy__(self) -> Sentence:
        return self

    def __deepcopy__(self, memo: object) -> Sentence:
        return self


class Pattern:
    """Sentence with placeholders. Call it with the arguments to create a `Sentence`.

    A second pattern with the same id and another text is an error.
    """

    def __init__(self, id: str, english: str) -> None:
        if not _ID.fullmatch(id):
            raise ValueError(f"sentence id {id!r}: expected words of a-z, 0-9 and _ with dots between them")
        self.id, self.english, self.names = id, english, names_of(english)
        if len(id) > _LONGEST_ID or len(self.names) > _MOST:
            raise ValueError(f"sentence id {id!r}: at most {_LONGEST_ID} characters, and {_MOST} arguments")
        first = _KNOWN.setdefault(id, self)  # state: as said there
        if first.english != english:
            raise ValueError(f"sentence id {id!r} is declared twice: {first.english!r} and {english!r}")

    def __call__(self, **arguments: object) -> Sentence:
        if arguments.keys() != self.names:
            raise TypeError(
                f"sentence {self.id}: arguments {sorted(arguments)}, expected {sorted(self.names)}"
            )
        texts = {name: _argument(value) for name, value in arguments.items()}
        return Sentence(self.english.format(**arguments), self.id, texts)


def fixed(id: str, english: str) -> Sentence:
    """Declare a sentence without arguments and return it."""
    return Pattern(id, english)()


def declared_patterns() -> Iterator[Pattern]:
    """Return the patterns of all imported modules, sorted by id."""
    return (_KNOWN[id] for id in sorted(_KNOWN))


def names_of(pattern: str) -> frozenset[str]:
    """Return the names of the arguments in a pattern.

    Raises:
        ValueError: a placeholder has more than a name, !r and a simple format.
    """
    names = set()
    for _, name, spec, conversion in Formatter().parse(pattern):
        if name is None:
            continue
        if not _NAME.fullmatch(name) or not _SPEC.fullmatch(spec or "") or conversion not in (None, "r"):
            raise ValueError(
                f"{pattern!r}: {{{name}}} is no argument; allowed: a name, !r, and formats such as :.2f, :g, :d, :.80"
            )
        names.add(name)
    return frozenset(names)


def plain(text: str) -> str:
    """Return the text as an instance of `str` itself, not of a subclass such as Sentence."""
    return str.__str__(text)


def identity(text: str) -> dict[str, Any]:
    """Return id and arguments of a sentence in wire form; "" and {} for a text that is no sentence."""
    if not isinstance(text, Sentence):
        return {"id": "", "arguments": {}}
    return {
        "id": text.id,
        "arguments": {name: _argument_to_wire(value) for name, value in text.arguments.items()},
    }


def rewritten(text: str, change: Callable[[str], str]) -> str:
    """Return the text with `change` applied to it and to all nested texts; the id is kept."""
    if not isinstance(text, Sentence):
        return change(text)
    parts = {
        name: rewritten(of, change) if isinstance(of, str) else of for name, of in text.arguments.items()
    }
    return Sentence(change(plain(text)), text.id, parts)


def shows(text: str, arguments: Mapping[str, Any]) -> bool:
    """Return True if all arguments (wire form) appear in the text, so that they reveal no more than the text does."""
    for value in arguments.values():
        if isinstance(value, Mapping):
            nested = str(value.get("text"))
            if nested not in text or not shows(nested, value.get("arguments") or {}):
                return False
        elif (f"{value:g}" if isinstance(value, float) else str(value)) not in text:
            return False
    return True


def to_wire(text: str) -> dict[str, Any]:
    """Return a sentence in wire form: {"id", "arguments", "text"}."""
    return {**identity(text), "text": plain(text)}


def within(tree: object) -> dict[str, dict[str, Any]]:
    """Return ids and arguments of the sentences in nested maps and lists.

    The keys of the result are paths: the keys to a sentence, joined by dots, as in `texts`.
    """
    return {path: identity(text) for path, text in texts(tree).items() if isinstance(text, Sentence)}


def texts(tree: object) -> dict[str, str]:
    """Return the texts in nested maps and lists by path; a path is the keys to a text, joined by dots."""
    return dict(_texts(tree, ""))


def _texts(tree: object, path: str) -> Iterator[tuple[str, str]]:
    if isinstance(tree, str):
        yield path, tree
    elif isinstance(tree, Mapping | list):
        for key, value in tree.items() if isinstance(tree, Mapping) else enumerate(tree):
            yield from _texts(value, f"{path}.{key}" if path else str(key))


def from_wire(text: str, id: object, arguments: object, depth: int = 0) -> str:
    """Return a text from another process, as a Sentence if it has an id.

    Raises:
        ValueError: id or arguments are invalid.
    """
    if id == "":
        return text
    if not isinstance(id, str) or len(id) > _LONGEST_ID or not _ID.fullmatch(id):
        raise ValueError(f"id = {id!r:.120}; expected words of a-z, 0-9 and _ with dots between them")
    if not isinstance(arguments, Mapping) or len(arguments) > _MOST or depth >= _DEEPEST:
        raise ValueError(f"arguments of {id} are no map of at most {_MOST}, {_DEEPEST} deep")
    return Sentence(
        plain(text), id, {_name(name): _argument_from_wire(of, depth) for name, of in arguments.items()}
    )


def checked(said: object) -> dict[str, dict[str, Any]]:
    """Return the ids and arguments of sentences that another process has sent, by the path of each text.

    `said` is what the process has sent. Entries that are invalid are left out.
    """
    said = said if isinstance(said, Mapping) else {}
    sentences = {path: _checked(entry) for path, entry in said.items() if isinstance(entry, Mapping)}
    return {str(path): entry for path, entry in sentences.items() if entry}


def checked_row(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return a row that another process sent; invalid id and arguments are removed from it."""
    return {key: of for key, of in row.items() if key not in ("id", "arguments")} | _checked(row)


def _checked(said: Mapping[str, Any]) -> dict[str, Any]:
    try:
        text = from_wire("", said.get("id", ""), said.get("arguments"))
    except ValueError:
        return {}
    return identity(text) if isinstance(text, Sentence) else {}


def _name(name: object) -> str:
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise ValueError(f"argument {name!r:.80}; expected a name of a-z, 0-9 and _")
    return name


def _argument_from_wire(value: object, depth: int) -> Argument:
    if isinstance(value, Mapping):
        text = value.get("text")
        if not isinstance(text, str):
            raise ValueError(f"an argument's text is {text!r:.80}; expected a str")
        return from_wire(text, value.get("id"), value.get("arguments"), depth + 1)
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        raise ValueError(f"argument {value!r:.80}; expected a number, a str or a sentence")
    if isinstance(value, float) and not isfinite(value):
        raise ValueError(f"argument {value}; expected a finite number")
    return value


def _argument_to_wire(value: Argument) -> Argument | dict[str, Any]:
    return to_wire(value) if isinstance(value, Sentence) else value


def _argument(value: object) -> Argument:
    """Return the value in a form that can be sent: no NaN (JSON), at most 2**53 (browsers), limited depth.

    An enumeration with a `sentence` becomes that sentence.
    """
    if isinstance(value, Sentence):
        return value if value.depth < _DEEPEST else plain(value)
    if isinstance(value, Enum):
        return _argument(getattr(value, "sentence", value.value))
    if isinstance(value, str):
        return str.__str__(value)
    if isinstance(value, float):  # before Real: isinstance of an abstract number class is slower
        return float(value) if isfinite(value) else str(value)
    if isinstance(value, bool):
        return str(value)
    if isinstance(value, Integral):
        return int(value) if abs(int(value)) <= _LARGEST else str(value)
    return _argument(float(value)) if isinstance(value, Real) else str(value)


_JOINED = {
    ";": Pattern("sentences.joined", "{first}; {rest}"),
    ",": Pattern("sentences.listed", "{first}, {rest}"),
}


def series(texts: Sequence[str], mark: Literal[";", ","] = ";") -> str:
    """Join texts to one sentence with `mark` between them; "" if there are none."""
    joined, *earlier = reversed(texts or [""])
    for text in earlier:
        joined = _JOINED[mark](first=text, rest=joined)
    return joined
