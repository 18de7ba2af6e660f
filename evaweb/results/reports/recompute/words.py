"""What the report's page and headline say in words, held against the numbers."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from html.parser import HTMLParser
from typing import Any

from .designs import Block, arms_of
from .numbers import Trial
from .record import HIDDEN

_FROM = 6  # of plans, the format whose reveals keep words


def headline_faults(
    said: Sequence[Mapping[str, Any]], blocks: Sequence[Block], plan: Mapping[str, Any], told: Sequence[str]
) -> list[str]:
    """What the sentences of a reveal do not say, or say beyond it, of what the design found of its blocks."""
    if plan.get("format", 1) < _FROM or not said:
        return []
    left, found = list(told), []
    for one in said:
        ways = list(_ways(one, blocks, plan))
        ours = [sentence for sentence in left if sentence.startswith(tuple(ways))]
        if ours:
            left.remove(ours[0])
        else:
            found.append(f"headline: no sentence begins {' or '.join(map(repr, ways))}")
    best = _best(said, plan)
    if best and (ours := [sentence for sentence in left if sentence.startswith(best)]):
        left.remove(ours[0])
    elif best:
        found.append(f"headline: no sentence begins {best!r}")
    return found + [f"headline: nothing comes out as {sentence!r}" for sentence in left]


def _ways(one: Mapping[str, Any], blocks: Sequence[Block], plan: Mapping[str, Any]) -> Iterator[str]:
    """How the sentence of a comparison may begin, with its counts."""
    first, second, stopping = one["first"], one["second"], plan["stopping"]
    if one["at"] is None:
        yield f"{first} and {second} were not compared: closed after {one['blocks']} of "
        yield f"{first} and {second} would not be compared yet after {one['blocks']} of "
        return
    better, worse = (second, first) if one["winner"] == second else (first, second)
    arms, margin = arms_of(plan), stopping.get("margin")
    sides = [
        [value for block in blocks[: one["at"]] for arm, value in block if arms[arm] == name]
        for name in (better, worse)
    ]
    counts = " against ".join(f"{sum(side):.0f}/{len(side)}" for side in sides)
    by_score = stopping.get("outcome") == "score"
    if by_score:
        means = (f"{sum(side) / len(side):.2f}" for side in sides)
        counts = f"mean scores {' and '.join(means)}"
    if margin is not None:
        shown = "" if one["winner"] else "not shown to be "
        yield f"{first} is {shown}not worse than {second} by {100 * margin:g} points or more: {counts}"
    elif one["winner"] is None:
        yield f"No significant difference between {first} and {second}: {counts}"
        yield f"Undecided: {one['at']} {_unit(plan)} cannot tell {first} and {second} apart: {counts}"
    elif not by_score:
        yield f"{better} succeeded more often than {worse}: {counts}"
    elif one["p"] is not None:  # flipped signs within pairs test whether two can be exchanged
        yield f"Scores of {better} and {worse} differ: {counts}"
    else:
        yield f"{better} reached higher scores than {worse}: {counts}"


def _unit(plan: Mapping[str, Any]) -> str:
    return "blocks" if plan["stopping"].get("counts") else "pairs"


def _best(said: Sequence[Mapping[str, Any]], plan: Mapping[str, Any]) -> str:
    """How the sentence on the best of several begins, "" where there is to be none."""
    arms, stopping = arms_of(plan), plan["stopping"]
    of_all = len(arms) > 2 and 2 * len(said) == len(arms) * (len(arms) - 1)
    differ = stopping.get("outcome") == "score" and any(one["p"] is not None for one in said)
    if not of_all or differ or stopping.get("margin") is not None or any(one["at"] is None for one in said):
        return ""
    beaten = {
        one["first"] if one["winner"] == one["second"] else one["second"] for one in said if one["winner"]
    }
    left = [arm for arm in arms if arm not in beaten]
    if len(left) == 1:
        return f"{left[0]} is the best of {len(arms)}"
    if not left:
        return f"No best of {len(arms)} was found"
    return f"No single best of {len(arms)}: "


def page_faults(page: str, shown: Mapping[str, Any], trials: Sequence[Trial]) -> list[str]:
    """What the page's tables of checkpoints and trials say otherwise than numbers.json and trials.csv."""
    reader = _Tables()
    reader.feed(HIDDEN.sub("", page))
    arms = {row[0]: row for row in reader.below("Checkpoint", "Groups")}
    found = [
        f"index.html says of {name} {arms.get(name, ['', '', 'nothing'])[2:6]}, numbers.json {wanted}"
        for name, arm in shown["arms"].items()
        if not _begin_with(arms.get(name, [])[2:6], wanted := _cells(arm))
    ]
    counted = [trial for trial in trials if trial.status == "scored"]
    rows = {row[0]: row[1:6] for row in reader.below("#", "Checkpoint", "Condition")}
    for trial in counted:
        wanted = [trial.checkpoint, trial.condition, "yes" if trial.success else "no"]
        *given, score, time = rows.pop(str(trial.order), ["", ""])
        if given != wanted or not (
            _is_rounded(score, trial.score, 2) and _is_rounded(time, trial.duration, 1)
        ):
            said = ", ".join(map(str, (*wanted, trial.score, trial.duration)))
            found.append(f"index.html does not say of trial {trial.order}: {said}")
    return found + [f"index.html has a trial {order}, which does not count" for order in rows]


def _is_rounded(cell: str, value: float | None, digits: int) -> bool:
    """Whether it is the value, rounded to so many digits in any way."""
    if value is None:
        return cell == ""
    try:
        return abs(float(cell) - value) < 0.5001 * 10.0**-digits
    except ValueError:
        return False


def _cells(arm: Mapping[str, Any]) -> list[str]:
    """Of a checkpoint its rate, its exact interval, its mean score and the mean of its scenes, as the page has them."""
    rate = f"{arm['successes']}/{arm['n']}, {100 * arm['rate']:.0f} % [{_ends(arm['wilson'])}]"
    means = (
        f"{100 * arm[name]['value']:.0f} % [{_ends(arm[name]['gaffke'])}]" for name in ("score", "macro")
    )
    return [rate, f"[{_ends(arm['clopper_pearson'])}]", *means]


def _ends(interval: Sequence[float]) -> str:
    return ", ".join(f"{100 * end:.0f}".replace("-0", "0").replace("-", "−") for end in interval)


def _begin_with(given: Sequence[str], wanted: Sequence[str]) -> bool:
    return len(given) == len(wanted) and all(a.startswith(b) for a, b in zip(given, wanted, strict=True))


class _Tables(HTMLParser):
    """Reads the text of tables' cells."""

    def __init__(self) -> None:
        super().__init__()
        self._tables: list[list[list[str]]] = []
        self._open = False

    def below(self, *head: str) -> list[list[str]]:
        """The rows of the tables whose head begins so."""
        return [row for rows in self._tables if rows and rows[0][: len(head)] == [*head] for row in rows[1:]]

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag == "table":
            self._tables.append([])
        elif tag == "tr" and self._tables:
            self._tables[-1].append([])
        elif tag in ("td", "th") and self._tables and self._tables[-1]:
            self._tables[-1][-1].append("")
            self._open = True

    def handle_endtag(self, tag: str) -> None:
        if tag in ("td", "th"):
            self._open = False

    def handle_data(self, data: str) -> None:
        if self._open:
            row = self._tables[-1][-1]
            row[-1] = re.sub(r"\s+", " ", row[-1] + data)
