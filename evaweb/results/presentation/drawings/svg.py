"""SVG building blocks: elements with escaped text, scales, axes."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from html import escape as html_escape
from itertools import count

from evaweb.core.tabular_export import iter_csv
from evaweb.statistics.proportions import Proportion

SERIES = 8  # series with a style of their own; further ones start again
LINE = 15.0  # line spacing of a label
_LETTER = 7.6  # approximate width of a character
PROPORTION = ("successes", "trials", "rate", "low", "high")  # columns of x of n with its interval
_SHARED = count(1)  # figures of one page have different ids, whoever draws them
_numbers: ContextVar[Iterator[int]] = ContextVar("drawing numbers", default=_SHARED)
_NOT_XML = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")


def escape(text: str) -> str:
    """Return the text escaped for XML; characters that XML cannot represent, as in some old names, become U+FFFD."""
    return html_escape(_NOT_XML.sub("\ufffd", text))


@contextmanager
def restart_numbering() -> Iterator[None]:
    """Number the figures that are drawn within the context from 1, so that equal documents have equal bytes."""
    token = _numbers.set(count(1))
    try:
        yield
    finally:
        _numbers.reset(token)


class Drawing(str):
    """Finished figure as markup with its data as CSV inside; templates insert it unescaped."""

    heading: str
    words: str

    def __html__(self) -> str:
        """Return the markup; Django and Jinja call this for safe strings."""
        return self


def drawing(
    width: float,
    height: float,
    title: str,
    words: str,
    *parts: str,
    kind: str,
    columns: Sequence[str],
    rows: Iterable[Sequence[object]],
) -> Drawing:
    """Return a figure that shrinks with its page.

    Args:
        width: Width [user units].
        height: Height [user units].
        title: Title of the figure.
        words: Description of the figure as text.
        parts: Elements as markup.
        kind: Style class.
        columns: Names of the columns of `rows`.
        rows: Numbers from which the figure was drawn; they are embedded as CSV.
    """
    name = f"drawing-{next(_numbers.get())}"
    inner = "".join(parts)
    role = "group" if "<a " in inner else "img"  # an image may not contain links
    data = "".join(iter_csv(columns, [[dict(zip(columns, row, strict=True)) for row in rows]]))
    text = (
        f'<svg class="drawing {escape(kind)}" viewBox="0 0 {_n(width)} {_n(height)}" width="{_n(width)}" '
        f'role="{role}" aria-labelledby="{name}-t {name}-d">'
        f'<title id="{name}-t">{escape(title)}</title><desc id="{name}-d">{escape(words)}</desc>'
        f"<metadata>{escape(data)}</metadata>{inner}</svg>"
    )
    figure = Drawing(text)
    figure.heading, figure.words = title, words
    return figure


_PRINTED = {
    "grid": 'fill="none" stroke="#cccccc"',
    "band": 'fill="#bbbbbb"',
    "mark": 'fill="#000000"',
    "tick": 'font-size="12.5"',
    "value": "",
}


def printable(figure: Drawing, above: Sequence[str], below: Sequence[str]) -> str:
    """Return a figure of rates as a standalone file: black on white, with inline styles and lines of text above and
    below.

    Equal figures give equal bytes.
    """
    size = re.search(r'viewBox="0 0 (\S+) (\S+)"', figure)
    inner = re.search(r"</metadata>(.*)</svg>", figure, re.DOTALL)
    if size is None or inner is None:
        raise ValueError(f"{figure!r:.80} is no drawing")
    width, height = float(size[1]), float(size[2])
    most = int(width / _LETTER)
    head = [row for text in above for row in wrapped(text, most, len(text))]
    foot = [row for text in below for row in wrapped(text, most, len(text))]
    step = LINE + 3
    top = step * len(head) + 12
    drawn = re.sub(r' class="(\w*)[^"]*"', lambda found: f" {_PRINTED[found[1]]}".rstrip(), inner[1])
    rows = [words(0, step * (i + 1) - 4, row) for i, row in enumerate(head)]
    rows += [words(0, top + height + step * (i + 1), row) for i, row in enumerate(foot)]
    total = top + height + step * len(foot) + 12
    title = element("title", escape(figure.heading)) + element("desc", escape(figure.words))
    ground = element("rect", width=width, height=total, fill="#ffffff")
    return element(
        "svg",
        title + ground + "".join(rows) + element("g", drawn, transform=f"translate(0 {_n(top)})"),
        xmlns="http://www.w3.org/2000/svg",
        viewBox=f"0 0 {_n(width)} {_n(total)}",
        width=width,
        height=total,
        font_family="Helvetica, Arial, sans-serif",
        font_size=14.0,
        fill="#000000",
    )


def counted(found: Proportion) -> tuple[object, ...]:
    """Return the values of a proportion for the columns whose names are in PROPORTION."""
    interval = found.interval
    return (found.successes, found.n, found.rate, interval and interval.low, interval and interval.high)


def element(tag: str, content: str = "", /, **attributes: object) -> str:
    """Return one element; `class_` becomes class, underscores become hyphens, `content` is markup."""
    written = "".join(
        f' {name.rstrip("_").replace("_", "-")}="{escape(_n(value) if isinstance(value, float) else str(value))}"'
        for name, value in attributes.items()
        if value is not None
    )
    return f"<{tag}{written}>{content}</{tag}>" if content else f"<{tag}{written}/>"


def words(x: float, y: float, text: str, anchor: str = "start", class_: str = "") -> str:
    """Return an element with one line of text at (`x`, `y`)."""
    return element("text", escape(text), x=float(x), y=float(y), text_anchor=anchor, class_=class_ or None)


def line(points: Sequence[tuple[float, float]], class_: str) -> str:
    """Return an element with straight lines between points."""
    return element("path", d=path(points), class_=class_)


def path(points: Sequence[tuple[float, float]]) -> str:
    """Return the attribute `d` of a path."""
    return "".join(f"{'L' if i else 'M'}{_n(x)} {_n(y)}" for i, (x, y) in enumerate(points))


def link(address: str, title: str, content: str) -> str:
    """Return the content with a tooltip, as a link to `address`; without a link if `address` is ""."""
    inner = element("title", escape(title)) + content
    return element("a", inner, href=address) if address else element("g", inner)


def series(i: int | None) -> str:
    """Return the style class of series `i`; None stands for a shape that belongs to no checkpoint."""
    return "series-none" if i is None else f"series-{i % SERIES + 1}"


def mark(i: int | None, x: float, y: float, r: float = 5) -> str:
    """Return the mark of the i-th series.

    Each series has a shape of its own, because not every reader can distinguish the colours.
    """
    shapes = (
        f"M{_n(x - r)} {_n(y)}a{_n(r)} {_n(r)} 0 1 0 {_n(2 * r)} 0a{_n(r)} {_n(r)} 0 1 0 {_n(-2 * r)} 0Z",
        path([(x - r, y - r), (x + r, y - r), (x + r, y + r), (x - r, y + r)]) + "Z",
        path([(x, y - r * 1.2), (x + r * 1.2, y + r), (x - r * 1.2, y + r)]) + "Z",
        path([(x, y - r * 1.3), (x + r * 1.3, y), (x, y + r * 1.3), (x - r * 1.3, y)]) + "Z",
    )
    shape = shapes[((i or 0) + (i or 0) // SERIES) % len(shapes)]
    return element("path", d=shape, class_=f"mark {series(i)}")


@dataclass(frozen=True, slots=True)
class Scale:
    """Linear scale from values `low` to `high` to positions `start` to `end`."""

    low: float
    high: float
    start: float
    end: float

    def __call__(self, value: float) -> float:
        """Return the position of a value, clamped to the ends."""
        span = self.high - self.low
        share = (
            (min(max(value, min(self.low, self.high)), max(self.low, self.high)) - self.low) / span
            if span
            else 0.0
        )
        return self.start + share * (self.end - self.start)


def ticks(low: float, high: float, wanted: int = 5) -> list[float]:
    """Return round values from `low` to `high`, about `wanted` of them."""
    span = high - low
    if span <= 0:
        return [low]
    raw = span / wanted
    power = 10 ** math.floor(math.log10(raw))
    step = next(power * factor for factor in (1, 2, 2.5, 5, 10) if power * factor >= raw * 0.999)
    first = math.ceil(low / step - 1e-9)
    return [round((first + i) * step, 10) for i in range(int((high - first * step) / step + 1e-9) + 1)]


def number(value: float, digits: int = 3) -> str:
    """Return the label of an axis value."""
    return f"{value:.{digits}g}".replace("-", "−")


def percent_axis(scale: Scale, y: float, top: float, step: int = 25) -> str:
    """Return the axis of shares: grid lines from `top` to `y`, and percentages below."""
    parts = []
    for share in range(0, 101, step):
        x = scale(share / 100)
        parts.append(line([(x, top), (x, y)], "grid"))
        parts.append(words(x, y + 16, f"{share}" + (" %" if share == 100 else ""), "middle", "tick"))
    return "".join(parts)


def wrapped(text: str, most: int, rows: int = 2) -> list[str]:
    """Return the text in at most `rows` lines of at most `most` characters, broken after hyphen, slash, underscore or
    blank.

    Surplus text is cut from the middle, because names of checkpoints begin alike and differ at their ends.
    """
    lines = [""]
    for word in re.findall(r"[^\s\-_/]*[\s\-_/]?", text):
        for piece in (word[i : i + most] for i in range(0, len(word), most)):
            if len((lines[-1] + piece).rstrip()) > most:
                lines.append("")
            lines[-1] += piece
    if len(lines) <= rows:
        return [row.rstrip() for row in lines]
    budget = most * rows - 1
    whole = text[: budget // 2] + "…" + text[len(text) - (budget - budget // 2) :]
    return [whole[i : i + most] for i in range(0, len(whole), most)]


def label(x: float, y: float, text: str, most: int, anchor: str = "start", rows: int = 2) -> str:
    """Return a name in as few lines as possible, centred vertically at `y`."""
    lines = wrapped(text, most, rows)
    top = y - LINE * (len(lines) - 1) / 2
    return "".join(words(x, top + LINE * i, row, anchor) for i, row in enumerate(lines))


def legend(names: Sequence[tuple[int, str]], width: float) -> tuple[str, float]:
    """Return the legend of (series, name) in rows from the top of a figure, and its height."""
    parts, x, y = [], 0.0, 12.0
    for i, name in names:
        wide = 24 + _LETTER * len(name) + 20
        if x and x + wide > width:
            x, y = 0.0, y + 20
        parts.append(
            element("rect", x=x, y=y - 10, width=16.0, height=12.0, class_=f"beam {series(i)}")
            + words(x + 24, y, name)
        )
        x += wide
    return "".join(parts), y + 14 if names else 0.0


def _n(value: float | int) -> str:
    if isinstance(value, int):
        return str(value)
    return f"{value:.2f}".rstrip("0").rstrip(".") or "0"
