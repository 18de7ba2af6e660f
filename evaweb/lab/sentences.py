"""Catalogue of all translatable sentences, for translators, and comparison of a language with it.

Python declares sentences as patterns; scripts write `t("an.id", "English with {name}", { name })`, templates `{% t
"an.id" name=value %}English{% endt %}`.
"""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from django.apps import apps

from evaweb.accounts.roles import Role
from evaweb.core.languages import label_id
from evaweb.datasets.episode_list import RESULTS, VERDICTS
from evaweb.episodes.selectors import QUALITY, REVIEW
from runtime.core.sentences import Pattern, declared_patterns, names_of

_ROOT = Path(__file__).parents[2]
_IMPORT = "from runtime.core.sentences import"
_TEMPLATE = re.compile(r'\{% t "([^"]+)"((?:[^%]|%(?!\}))*?) ?%\}(.*?)\{% endt %\}', re.DOTALL)
_VALUE = re.compile(r"\s(\w+)=")
_SCRIPT = re.compile(r'(?<![\w.])t\(\s*"([^"]+)",\s*("(?:[^"\\]|\\.)*")')


@dataclass(frozen=True, slots=True)
class Entry:
    """Sentence to translate: id, English text, and names of its arguments."""

    id: str
    english: str
    names: frozenset[str]


def modules() -> Iterator[str]:
    """Yield the names of the modules that declare or use sentences."""
    for package in ("runtime", "evaweb"):
        for path in sorted((_ROOT / package).rglob("*.py")):
            if _IMPORT in path.read_text("utf-8"):
                yield ".".join(path.relative_to(_ROOT).with_suffix("").parts)


def of_python() -> list[Entry]:
    """Return the sentences that Python modules declare, ordered by id."""
    for module in modules():
        import_module(module)
    return [_entry(pattern) for pattern in declared_patterns()]


def of_scripts() -> list[Entry]:
    """Return the sentences of scripts.

    Raises:
        ValueError: If an id has two texts, or a call cannot be parsed.
    """
    entries: list[Entry] = []
    for path, source in _sources("static", "*.js"):
        read = [(id, json.loads(english)) for id, english in _SCRIPT.findall(source)]
        _require_all(path, source.count(' t("') + source.count('(t("') + source.count("{t("), len(read))
        entries += [Entry(id, english, names_of(english)) for id, english in read]
    return once(entries)


def of_templates() -> list[Entry]:
    """Return the sentences of templates.

    Raises:
        ValueError: If an id has two texts, or a tag cannot be parsed.
    """
    entries: list[Entry] = []
    for path, source in _sources("templates", "*.html"):
        read = _TEMPLATE.findall(source)
        _require_all(path, source.count("{% t "), len(read))
        entries += [
            Entry(id, " ".join(english.split()), frozenset(_VALUE.findall(values)))
            for id, values, english in read
        ]
    return once(entries)


def of_labels() -> list[Entry]:
    """Return the labels of `{% label %}`: columns, filters, tabs, roles and choices."""
    texts = {
        text for path, source in _sources("evaweb", "*.py") for text in _labels(ast.parse(source, str(path)))
    }
    texts |= {role.value for role in Role}
    texts |= {label for label, _ in (*QUALITY.values(), *REVIEW.values())} | {
        *RESULTS,
        *VERDICTS,
        "every attempt",
        "all",
    }
    for model in apps.get_models():
        if model.__module__.startswith("evaweb."):
            texts |= {str(text) for field in model._meta.fields for _, text in field.flatchoices}
    return once(Entry(label_id(text), text.casefold(), frozenset()) for text in sorted(texts) if text)


def catalogue(entries: Iterable[Entry]) -> list[dict[str, Any]]:
    """Return id, English text and argument names of each entry."""
    return [{"id": entry.id, "english": entry.english, "arguments": sorted(entry.names)} for entry in entries]


def compared(entries: Sequence[Entry], translated: Mapping[str, str]) -> dict[str, list[str]]:
    """Return the ids in which a language differs from the catalogue, by kind of difference.

    "missing": not translated; "unknown": not in the catalogue; "other_arguments": the translated text has unknown
    arguments or cannot be parsed.
    """
    english = {entry.id: entry for entry in entries}
    return {
        "missing": [id for id in english if id not in translated],
        "unknown": [id for id in translated if id not in english],
        "other_arguments": [
            id for id, text in translated.items() if id in english and not _fits(english[id], text)
        ],
    }


def once(entries: Iterable[Entry]) -> list[Entry]:
    """Return the entries without duplicates, ordered by id.

    Raises:
        ValueError: If an id has two texts.
    """
    by_id: dict[str, Entry] = {}
    for entry in entries:
        if by_id.setdefault(entry.id, entry) != entry:
            raise ValueError(f"{entry.id} is two texts: {by_id[entry.id].english!r} and {entry.english!r}")
    return [by_id[id] for id in sorted(by_id)]


def _labels(tree: ast.AST) -> Iterator[str]:
    """Yield the titles of columns, filters and tabs in a parsed module."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]).endswith("_TABS"):
            yield from (title for title, _ in ast.literal_eval(node.value))
        if (
            isinstance(node, ast.Call)
            and isinstance(node.func, ast.Name)
            and node.func.id in ("Column", "Filter")
        ):
            named = [
                keyword.value for keyword in node.keywords if keyword.arg in ("title", "label", "hint", "any")
            ]
            for text in (*node.args[1:2], *named):
                if isinstance(text, ast.Constant) and isinstance(text.value, str):
                    yield text.value


def _entry(pattern: Pattern) -> Entry:
    return Entry(pattern.id, pattern.english, pattern.names)


def _sources(folder: str, names: str) -> Iterator[tuple[Path, str]]:
    for path in sorted((_ROOT / folder).rglob(names)):
        yield path, path.read_text("utf-8")


def _require_all(path: Path, written: int, read: int) -> None:
    if read < written:
        raise ValueError(f"{path}: {written} texts with an id are written there, {read} can be read")


def _fits(english: Entry, text: str) -> bool:
    try:
        return names_of(text) <= english.names
    except ValueError:
        return False
