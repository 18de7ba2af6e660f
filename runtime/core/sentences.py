"""Sentences that people read, with an id and arguments beside the English: what a translation is made from.

A module declares its sentences as `Pattern`s beside where they are used, and calls one to say it. What comes out is
a `str`, so that logs, records and whoever compares go on with the English.
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
_SPEC = re.compile(r"(\.\d)?[fg]|d|\.\d{1,3}|")  # pages read the same ones: static/site/sentences.js
_LONGEST_ID, _MOST, _DEEPEST = 100, 24, 8
_LARGEST = 2**53

_KNOWN: dict[str, Pattern] = {}  # state: the patterns of the modules that were imported, by id


class Sentence(str):
    """An English sentence that knows its `id` and `arguments`. Concatenated or formatted it is a plain str."""

    __slots__ = ("arguments", "depth", "id")
    id: str
    arguments: Mapping[str, Argument]
    depth: int  # 1 where no argument is a sentence

    def __new__(cls, text: str, id: str, arguments: Mapping[str, Argument]) -> Sentence:
        made = super().__new__(cls, text)
        made.id, made.arguments = id, arguments
        made.depth = 1 + max((of.depth for of in arguments.values() if isinstance(of, Sentence)), default=0)
        return made

    def __str__(self) -> str:
        return self  # so that str() of an exception is the sentence that it was raised with

    def __getnewargs__(self) -> tuple[str, str, Mapping[str, Argument]]:  # type: ignore[override]
        return plain(self), self.id, self.arguments

    def __copy__(self) -> Sentence:
        return self

    def __deepcopy__(self, memo: object) -> Sentence:
        return self


class Pattern:
    """A sentence before its arguments are known; a second one of the same id that says something else is an error."""

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
        told = {name: _argument(value) for name, value in arguments.items()}
        return Sentence(self.english.format(**arguments), self.id, told)


def fixed(id: str, english: str) -> Sentence:
    """A sentence without arguments, declared and said at once."""
    return Pattern(id, english)()


def known() -> Iterator[Pattern]:
    """The patterns of all modules that were imported, in the order of their ids."""
    return (_KNOWN[id] for id in sorted(_KNOWN))


def names_of(pattern: str) -> frozenset[str]:
    """Names of the arguments in a pattern; ValueError where it asks for more than a name and a simple format."""
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
    """The text as an exact str."""
    return str.__str__(text)


def identity(text: str) -> dict[str, Any]:
    """Id and arguments of a sentence as they travel; "" and {} for any other text."""
    if not isinstance(text, Sentence):
        return {"id": "", "arguments": {}}
    return {"id": text.id, "arguments": {name: _told(value) for name, value in text.arguments.items()}}


def rewritten(text: str, change: Callable[[str], str]) -> str:
    """The text and all that it is made of, each through `change`; it keeps its id."""
    if not isinstance(text, Sentence):
        return change(text)
    parts = {
        name: rewritten(of, change) if isinstance(of, str) else of for name, of in text.arguments.items()
    }
    return Sentence(change(plain(text)), text.id, parts)


def shows(text: str, arguments: Mapping[str, Any]) -> bool:
    """True if all that arguments say, as they travel, stands in the text: who may read it may have them."""
    for value in arguments.values():
        if isinstance(value, Mapping):
            nested = str(value.get("text"))
            if nested not in text or not shows(nested, value.get("arguments") or {}):
                return False
        elif (f"{value:g}" if isinstance(value, float) else str(value)) not in text:
            return False
    return True


def told(text: str) -> dict[str, Any]:
    """A sentence as it travels: {"id", "arguments", "text"}."""
    return {**identity(text), "text": plain(text)}


def within(tree: object) -> dict[str, dict[str, Any]]:
    """Ids and arguments of the sentences in maps and lists, by where they stand."""
    return {path: identity(text) for path, text in texts(tree).items() if isinstance(text, Sentence)}


def texts(tree: object) -> dict[str, str]:
    """The texts in maps and lists, by where they stand: the keys that lead there, with dots between them."""
    return dict(_texts(tree, ""))


def _texts(tree: object, path: str) -> Iterator[tuple[str, str]]:
    if isinstance(tree, str):
        yield path, tree
    elif isinstance(tree, Mapping | list):
        for key, value in tree.items() if isinstance(tree, Mapping) else enumerate(tree):
            yield from _texts(value, f"{path}.{key}" if path else str(key))


def heard(text: str, id: object, arguments: object, depth: int = 0) -> str:
    """What another process said, a Sentence where it has an id; ValueError for what is none."""
    if id == "":
        return text
    if not isinstance(id, str) or len(id) > _LONGEST_ID or not _ID.fullmatch(id):
        raise ValueError(f"id = {id!r:.120}; expected words of a-z, 0-9 and _ with dots between them")
    if not isinstance(arguments, Mapping) or len(arguments) > _MOST or depth >= _DEEPEST:
        raise ValueError(f"arguments of {id} are no map of at most {_MOST}, {_DEEPEST} deep")
    return Sentence(plain(text), id, {_name(name): _heard(of, depth) for name, of in arguments.items()})


def checked(said: object) -> dict[str, dict[str, Any]]:
    """Ids and arguments by where their texts stand, as another process has said them; without those that are none."""
    said = said if isinstance(said, Mapping) else {}
    found = {path: _checked(one) for path, one in said.items() if isinstance(one, Mapping)}
    return {str(path): one for path, one in found.items() if one}


def checked_row(row: Mapping[str, Any]) -> dict[str, Any]:
    """A row as another process has said it; without its id and arguments where they are none."""
    return {key: of for key, of in row.items() if key not in ("id", "arguments")} | _checked(row)


def _checked(said: Mapping[str, Any]) -> dict[str, Any]:
    try:
        text = heard("", said.get("id", ""), said.get("arguments"))
    except ValueError:
        return {}
    return identity(text) if isinstance(text, Sentence) else {}


def _name(name: object) -> str:
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise ValueError(f"argument {name!r:.80}; expected a name of a-z, 0-9 and _")
    return name


def _heard(value: object, depth: int) -> Argument:
    if isinstance(value, Mapping):
        text = value.get("text")
        if not isinstance(text, str):
            raise ValueError(f"an argument's text is {text!r:.80}; expected a str")
        return heard(text, value.get("id"), value.get("arguments"), depth + 1)
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        raise ValueError(f"argument {value!r:.80}; expected a number, a str or a sentence")
    if isinstance(value, float) and not isfinite(value):
        raise ValueError(f"argument {value}; expected a finite number")
    return value


def _told(value: Argument) -> Argument | dict[str, Any]:
    return told(value) if isinstance(value, Sentence) else value


def _argument(value: object) -> Argument:
    """The value as it may travel: JSON knows no NaN, pages count to 2**53, and nobody takes what is nested too deep.

    Of an enumeration that has a sentence, it is that.
    """
    if isinstance(value, Sentence):
        return value if value.depth < _DEEPEST else plain(value)
    if isinstance(value, Enum):
        return _argument(getattr(value, "sentence", value.value))
    if isinstance(value, str):
        return str.__str__(value)
    if isinstance(value, float):  # asked before the numbers of others, which take longer to tell
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
    """All of them in one sentence, with such marks between; "" for none."""
    made, *others = reversed(texts or [""])
    for text in others:
        made = _JOINED[mark](first=text, rest=made)
    return made
