"""The catalogue of all sentences, for who writes a language, and what such a language lacks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from runtime.core.sentences import Pattern, known, names_of

_ROOT = Path(__file__).parents[2]
_IMPORT = "from runtime.core.sentences import"


def modules() -> Iterator[str]:
    """Names of the modules that declare sentences, or only use them."""
    for package in ("runtime", "evaweb"):
        for path in sorted((_ROOT / package).rglob("*.py")):
            if _IMPORT in path.read_text("utf-8"):
                yield ".".join(path.relative_to(_ROOT).with_suffix("").parts)


def declared() -> list[Pattern]:
    """Every pattern that there is, in the order of the ids."""
    for module in modules():
        import_module(module)
    return list(known())


def catalogue(patterns: list[Pattern]) -> list[dict[str, Any]]:
    """Id, English pattern and names of the arguments of each."""
    return [{"id": one.id, "english": one.english, "arguments": sorted(one.names)} for one in patterns]


def compared(patterns: list[Pattern], translated: Mapping[str, str]) -> dict[str, list[str]]:
    """Ids that a language lacks ("missing"), that there are none of ("unknown"), and whose patterns do not fit.

    "other_arguments": a pattern that names what its sentence has not, or cannot be read.
    """
    english = {one.id: one for one in patterns}
    return {
        "missing": [id for id in english if id not in translated],
        "unknown": [id for id in translated if id not in english],
        "other_arguments": [
            id for id, pattern in translated.items() if id in english and not _fits(english[id], pattern)
        ],
    }


def _fits(english: Pattern, pattern: str) -> bool:
    try:
        return names_of(pattern) <= english.names
    except ValueError:
        return False
