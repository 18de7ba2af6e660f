"""Comparisons of more than two arms: corrected probabilities, and compact letters that summarise them.

Formulae: Holm (1979); compact letters by insertion and absorption (Piepho 2004).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from itertools import combinations

from evaweb.statistics.base import StatisticsError, check_share


def holm(probabilities: Sequence[float]) -> list[float]:
    """Return the probabilities corrected by Holm's procedure, in the given order."""
    for value in probabilities:
        check_share("p", value)
    order = sorted(range(len(probabilities)), key=lambda i: probabilities[i])
    corrected = [0.0] * len(probabilities)
    highest = 0.0
    for rank, i in enumerate(order):
        highest = max(highest, min(1.0, (len(order) - rank) * probabilities[i]))
        corrected[i] = highest
    return corrected


def letters(names: Sequence[str], separated: Collection[frozenset[str]]) -> dict[str, str]:
    """Return letters for `names` (best first) such that two share a letter if and only if they are not `separated`.

    `separated` are the pairs, as sets of two names, that a test found to differ.
    """
    if len(set(names)) != len(names):
        raise StatisticsError(f"a name stands twice in {list(names)}")
    for pair in separated:
        if len(pair) != 2 or not pair <= set(names):
            raise StatisticsError(f"separated pair {sorted(pair)}; allowed: two of {list(names)}")
    columns: list[frozenset[str]] = [frozenset(names)] if names else []
    for first, second in combinations(names, 2):
        if frozenset((first, second)) not in separated:
            continue
        split: list[frozenset[str]] = []
        for column in columns:
            split += [column - {first}, column - {second}] if {first, second} <= column else [column]
        columns = _absorbed(split)
    place = {name: i for i, name in enumerate(names)}
    columns.sort(key=lambda column: sorted(place[name] for name in column))
    return {name: "".join(_letter(i) for i, column in enumerate(columns) if name in column) for name in names}


def _absorbed(columns: list[frozenset[str]]) -> list[frozenset[str]]:
    """Return the columns without those that are contained in another."""
    retained: list[frozenset[str]] = []
    for column in sorted(set(columns), key=lambda column: (-len(column), sorted(column))):
        if not any(column <= larger for larger in retained):
            retained.append(column)
    return retained


def _letter(i: int) -> str:
    """Return letter `i`: a to z, then a1 to z1, a2 and so on, so that many groups stay readable."""
    return chr(ord("a") + i % 26) + (str(i // 26) if i >= 26 else "")
