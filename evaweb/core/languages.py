"""Languages of the pages: one JSON file each, with translations by id.

`sentences` are patterns with named arguments for messages of station, lab and scripts; `templates` replace the markup
between `{% t "id" %}` and `{% endt %}`. The source language is English; it is shown if a translation is missing.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from string import Formatter
from typing import Any

from django.conf import settings

from runtime.core import bounded_documents as bounded
from runtime.core.sentences import Sentence, names_of

log = logging.getLogger(__name__)
COOKIE = "eva_language"
_PART = re.compile(r"[a-z0-9]+")
_CODE = re.compile(r"[a-z]{2,3}(-[A-Z][A-Za-z]{1,3})?")
_LARGEST, _MOST = 4 << 20, 20_000  # limits of a language file [bytes], [values]


@dataclass(frozen=True, slots=True)
class Language:
    """A language: its code (`de`), its native name, and its patterns by id."""

    code: str
    name: str
    patterns: Mapping[str, str]
    templates: Mapping[str, str]


def offered() -> list[Language]:
    """Return the installed languages, sorted by code; a file that cannot be read is logged and skipped."""
    files = sorted(Path(settings.LANGUAGES_DIR).glob("*.json"))
    read = (_read(path, path.stat().st_mtime_ns) for path in files if _CODE.fullmatch(path.stem))
    return [language for language in read if language is not None]


def language(code: str) -> Language | None:
    """Return the language with this code, None if it is not installed."""
    return next((row for row in offered() if row.code == code), None)


def chosen(request: Any) -> Language | None:
    """Return the language that the browser has chosen, None for English; looked up once per request."""
    if not hasattr(request, "_eva_language"):
        code = request.COOKIES.get(COOKIE, "")
        request._eva_language = language(code) if _CODE.fullmatch(code) else None
    selected: Language | None = request._eva_language
    return selected


def parse(code: str, content: str) -> Language:
    """Return the language that a file describes. Raises: ValueError if its content is invalid."""
    document = bounded.parse_json(content, "the language", _LARGEST, _MOST)
    match document:
        case {"name": str(name), "sentences": dict(patterns), **rest}:
            templates = rest.get("templates", {})
        case _:
            raise ValueError(
                'expected {"name": its own name, "sentences": {id: pattern}, "templates": {id: words}}'
            )
    wrong = [
        key for part in (patterns, templates) for key, pattern in part.items() if not isinstance(pattern, str)
    ]
    if wrong:
        raise ValueError(f"{', '.join(wrong[:5])}: expected a text")
    return Language(code, name, patterns, templates)


def translated(text: str, spoken: Language | None) -> str:
    """Return the sentence in that language; `text` itself if it has no id or no usable translation."""
    pattern = spoken.patterns.get(text.id) if spoken is not None and isinstance(text, Sentence) else None
    if pattern is None:
        return text
    assert isinstance(text, Sentence)
    try:
        return _filled(pattern, text.arguments, spoken)
    except (ValueError, KeyError, IndexError):
        return text


def label(text: str, spoken: Language | None) -> str:
    """Return the translation of a table header, list entry or choice by `label_id`; `text` itself if there is none."""
    return spoken.patterns.get(label_id(text), text) if spoken is not None else text


def label_id(text: str) -> str:
    """Return the id of a label: "To be scored" is label.to_be_scored."""
    return f"label.{'_'.join(_PART.findall(text.casefold()))[:60] or 'empty'}"


def _filled(pattern: str, arguments: Mapping[str, Any], spoken: Language | None) -> str:
    names_of(pattern)  # ValueError if a field is more than a name
    return "".join(
        before + ("" if name is None else _shown(arguments[name], spec or "", conversion, spoken))
        for before, name, spec, conversion in Formatter().parse(pattern)
    )


def _shown(value: Any, spec: str, conversion: str | None, spoken: Language | None) -> str:
    text = translated(value, spoken) if isinstance(value, str) else value
    text = repr(str.__str__(text) if isinstance(text, str) else text) if conversion else text
    of_texts = spec.startswith(".") and spec[1:].isdigit()
    return format(text, spec if of_texts is isinstance(text, str) else "")


@lru_cache(maxsize=32)  # cache: of each file as it was last written
def _read(path: Path, written: int) -> Language | None:
    try:
        if path.stat().st_size > _LARGEST:
            raise ValueError(f"more than {_LARGEST} bytes")
        return parse(path.stem, path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        log.error("the language %s is not offered: %s", path, error)
        return None
