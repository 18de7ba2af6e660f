"""Report page as a reader perceives it: its statements, each exactly once, and nothing hidden."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from html.parser import HTMLParser
from typing import Any

_ALONE = frozenset({"meta", "br", "hr"})  # elements without an end tag
_DRAWN = frozenset({"svg", "g", "path", "rect", "line", "circle", "text", "title", "desc", "metadata"})
_TAGS = _DRAWN | {
    *(
        "html",
        "head",
        "body",
        "main",
        "section",
        "div",
        "p",
        "span",
        "h1",
        "h2",
        "h3",
        "ul",
        "ol",
        "li",
        "dl",
    ),
    *("dt", "dd", "table", "caption", "thead", "tbody", "tr", "th", "td", "figure", "figcaption", "time"),
    *("a", "code", "style", "details", "summary", *_ALONE),
}
_ATTRIBUTES = frozenset(
    {
        *(
            "class",
            "href",
            "id",
            "lang",
            "data-theme",
            "charset",
            "name",
            "content",
            "role",
            "scope",
            "rowspan",
        ),
        *("colspan", "datetime", "aria-labelledby", "aria-label", "title"),
    }
)
_OF_A_DRAWING = frozenset(
    {
        *("viewbox", "width", "height", "x", "y", "x1", "y1", "x2", "y2", "cx", "cy", "r", "d", "points"),
        *("fill-opacity", "text-anchor", "transform", "aria-hidden", "preserveaspectratio"),
    }
)
_HIDES = re.compile(
    r"display:\s*none|visibility:\s*hidden|clip-path:\s*inset|opacity:\s*0[;\s}]|font-size:\s*0(?![.\d])"
)
_PICTURE = re.compile(r"data/pictures/[0-9a-f]+\.jpg")
_UNREAD = frozenset({"style", "head", "title", "desc", "metadata"})
_SAID, _DOUBTS = "plan-sentence", "Reasons for doubt, as the reveal kept them"


class Node:
    """Element with its children: elements and texts."""

    def __init__(self, tag: str, attributes: Mapping[str, str]) -> None:
        self.tag, self.attributes = tag, attributes
        self.inner: list[Node | str] = []

    @property
    def classes(self) -> set[str]:
        """Style classes."""
        return set(self.attributes.get("class", "").split())

    @property
    def text(self) -> str:
        """Visible text, with blanks collapsed."""
        return plain("".join(self._texts()))

    def _texts(self) -> Iterator[str]:
        for part in self.inner:
            if isinstance(part, str):
                yield part
            elif part.tag not in _UNREAD:
                yield from part._texts()
                yield " " if part.tag in ("br", "p", "li", "td", "th", "div", "dd", "dt") else ""

    def all(self, *tags: str) -> Iterator[Node]:
        """Yield the descendants that have one of these tags, or all without tags, in document order."""
        for part in self.inner:
            if isinstance(part, Node):
                if not tags or part.tag in tags:
                    yield part
                yield from part.all(*tags)


class _Reader(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.root = Node("", {})
        self._open = [self.root]
        self.faults: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        node = Node(tag, {name: value or "" for name, value in attrs})
        if len(node.attributes) < len(attrs):
            self.faults.append(f"<{tag}> has an attribute twice")
        self._open[-1].inner.append(node)
        if tag not in _ALONE:
            self._open.append(node)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in _ALONE:
            self.handle_endtag(tag)

    def handle_endtag(self, tag: str) -> None:
        if self._open[-1].tag != tag:
            self.faults.append(f"<{self._open[-1].tag}> is not ended where </{tag}> stands")
        else:
            self._open.pop()

    def handle_data(self, data: str) -> None:
        self._open[-1].inner.append(data)


def plain(text: str) -> str:
    """Return the text with blanks collapsed."""
    return " ".join(text.split())


def read(page: str, styles: str | None) -> tuple[Node, list[str]]:
    """Return the parsed page, and a list of all that could hide or change its text.

    `styles` is the style sheet that the page must have, None if unknown.
    """
    reader = _Reader()
    reader.feed(re.sub(r"^\s*<!doctype html>", "", page, flags=re.IGNORECASE))
    reader.close()
    sentences = [f"index.html: {fault}" for fault in reader.faults]
    if "<!" in re.sub(r"^\s*<!doctype html>", "", page, flags=re.IGNORECASE):
        sentences.append("index.html has a comment")
    sheets = ["".join(map(str, node.inner)) for node in reader.root.all("style")]
    if len(sheets) != 1 or (styles is not None and sheets[0] != styles):
        sentences.append("index.html has another style than the report's own")
    hiding = _hiding("".join(sheets))
    for node in reader.root.all():
        allowed = _ATTRIBUTES | (_OF_A_DRAWING if node.tag in _DRAWN else frozenset())
        odd = sorted(set(node.attributes) - allowed) + sorted(node.classes & hiding)
        if node.tag not in _TAGS:
            sentences.append(f"index.html has <{node.tag}>, which no report has")
        elif odd:
            sentences.append(f"index.html has <{node.tag} {odd[0]}>, which no report has")
        href = node.attributes.get("href")
        if href is not None and not _PICTURE.fullmatch(href):
            sentences.append(f"index.html leads to {href}")
    return reader.root, sentences


def _hiding(styles: str) -> set[str]:
    """Return the classes whose style hides their elements."""
    classes: set[str] = set()
    for selectors, rules in re.findall(r"([^{}]+)\{([^{}]*)\}", styles):
        if _HIDES.search(rules):
            for selector in selectors.split(","):
                last = re.split(r"[\s>+~]", selector.strip())[-1]
                classes.update(re.findall(r"\.([\w-]+)", last) if ":" not in last else ())
    return classes


def page_contradictions(
    root: Node, seal: Mapping[str, Any], plan: Mapping[str, Any], shown: Mapping[str, Any]
) -> list[str]:
    """Return differences between the page's statements and the reveal, the plan and numbers.json."""
    reveal, text = seal["at_reveal"] or {}, root.text
    sentences = []
    if "headline" in reveal:  # from format 6 on
        for label, texts, expected in (
            ("headline", _sentences(root), [f"{sentence}." for sentence in reveal["headline"]]),
            (
                "reasons for doubt",
                _listed(root, _DOUBTS),
                [f"{sentence}." for sentence in reveal.get("caveats", ())],
            ),
        ):
            if texts != list(map(plain, expected)):
                sentences.append(f"index.html does not say: {expected or f'no {label}'}, but {texts}")
        if plain(reveal.get("setting", "")) not in text:
            sentences.append(f"index.html does not say: {reveal['setting']}")
    shows_key = any(node.text == "Key" for node in root.all("dt"))
    if bool(seal["key"]) != shows_key or ("State: revealed" in text and not seal["key"]):
        sentences.append("index.html says of reveal and key otherwise than seal.json")
    digests = [node.text for node in root.all("dd") if "mono" in node.classes]
    if digests != [value for value in (seal["digest"], seal["commitment"], seal["key"]) if value]:
        sentences.append("index.html has another digest, commitment or key than seal.json")
    if f"from {shown['n']} trials" not in text:
        sentences.append(f"index.html does not say that it is made from {shown['n']} trials")
    unsaid = (phrase for phrase in _planned(plan) if plain(phrase) not in text)
    return sentences + [f"index.html does not say of the plan: {phrase}" for phrase in unsaid]


def _planned(plan: Mapping[str, Any]) -> Iterator[str]:
    yield f"{plan['title']} v{plan['version']}"
    if plan.get("question", "").strip():
        yield plan["question"]
    for scene in plan["scenes"]:
        yield f"“{scene['instruction']}”"
        if scene.get("criterion"):
            yield f"Success: {scene['criterion']}"


def _sentences(root: Node) -> list[str]:
    nodes = [node for node in root.all() if _SAID in node.classes]
    return [text for node in nodes for text in ([li.text for li in node.all("li")] or [node.text])]


def _listed(root: Node, heading: str) -> list[str]:
    """Return the items of the list after a heading."""
    nodes = list(root.all("h3", "ul"))
    at = [i for i, node in enumerate(nodes) if node.tag == "h3" and node.text == heading]
    behind = [nodes[i + 1] for i in at if i + 1 < len(nodes) and nodes[i + 1].tag == "ul"]
    return [li.text for node in behind for li in node.all("li")]


def below(root: Node, *head: str) -> list[list[str]]:
    """Return the rows below the header `head` of the page's only table that begins with it.

    [] if there is no such table. If there are several, the result is one row that matches no expected row.
    """
    tables = [
        [[cell.text for cell in row.all("th", "td")] for row in table.all("tr")]
        for table in root.all("table")
    ]
    own = [rows for rows in tables if rows and rows[0][: len(head)] == [*head]]
    return own[0][1:] if len(own) == 1 else [["two tables"]] if own else []


def cells_fit(given: Sequence[str], wanted: Sequence[str], later: bool) -> bool:
    """Return True if each cell of a row has the wanted text.

    The first cell is a rate. If `later` is True, because scores were added after the reveal, a text about later
    corrections may follow the rate.
    """
    rate, *further = given or [""]
    return list(further) == list(wanted[1:]) and (
        rate == wanted[0] or (later and rate.startswith(f"{wanted[0]} with later corrections "))
    )
