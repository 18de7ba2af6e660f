"""Texts of templates that no language can say: whatever somebody reads and stands outside of `{% t %}`.

`python -m tests.lint.texts [FILE ...]` names each with its line.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path

ROOT = Path(__file__).parents[2] / "templates"
_UNSHOWN = r"\{% block (?:theme|body_class|all_key) %\}.*?\{% endblock %\}"  # attributes of the frame
_TEXT = re.compile(_UNSHOWN + r"|\{% t .*?\{% endt %\}|\{#.*?#\}|\{% comment.*?endcomment %\}", re.DOTALL)
_TAG = re.compile(r"\{%.*?%\}|\{\{.*?\}\}", re.DOTALL)
_FORMAT = re.compile(r"\S+=\S+")  # an example of what may be typed
_WORD = re.compile(r"[A-Za-z]{2,}")
_SHOWN = ("title", "aria-label", "aria-roledescription", "placeholder", "alt", "data-confirm")
_UNREAD = frozenset({"script", "style", "code", "kbd", "svg"})
_NAMES = frozenset(
    {
        *(
            "EVA",
            "English",
            "SPARC",
            "CSV",
            "JSON",
            "REST",
            "PNG",
            "SVG",
            "MCAP",
            "Hz",
            "ms",
            "mm",
            "kB",
            "MB",
            "GB",
        ),
        *("parquet", "OWNER", "NAME"),
    }
)
_NOT_PAGES = ("admin/", "results/report.html")


class _Reader(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.found: list[tuple[int, str]] = []
        self._unread = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._unread += tag in _UNREAD
        for name, value in attrs:
            if name in _SHOWN:
                self._look(value or "")

    def handle_endtag(self, tag: str) -> None:
        self._unread -= tag in _UNREAD

    def handle_data(self, data: str) -> None:
        if not self._unread:
            self._look(data)

    def _look(self, text: str) -> None:
        text = _FORMAT.sub("", text)
        if set(_WORD.findall(text)) - _NAMES:
            before = text[: len(text) - len(text.lstrip())].count("\n")
            self.found.append((self.getpos()[0] + before, " ".join(text.split())))


def _blank(match: re.Match[str]) -> str:
    return "\n" * match.group().count("\n")


def left(source: str) -> list[tuple[int, str]]:
    """Line and words of each text that is not said by its id."""
    reader = _Reader()
    reader.feed(_TAG.sub(_blank, _TEXT.sub(_blank, source)))
    reader.close()
    return reader.found


def everything() -> Iterator[str]:
    """All of them, as a linter has it."""
    for path in sorted(ROOT.rglob("*.html")):
        name = path.relative_to(ROOT).as_posix()
        if not name.startswith(_NOT_PAGES):
            yield from (f"templates/{name}:{line}: {words}" for line, words in left(path.read_text("utf-8")))


if __name__ == "__main__":
    named = [Path(name) for name in sys.argv[1:]]
    rows = (
        [f"{path}:{line}: {words}" for path in named for line, words in left(path.read_text("utf-8"))]
        if named
        else list(everything())
    )
    print("\n".join(rows) or "every text of a template has an id")
    sys.exit(bool(rows))
