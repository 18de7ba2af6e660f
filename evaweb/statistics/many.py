"""More than two arms: probabilities corrected for how many comparisons were made, and letters that sum them up.

Formulae: Holm (1979); compact letters by insertion and absorption (Piepho 2004).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from itertools import combinations

from evaweb.statistics.base import StatisticsError, check_share


def holm(probabilities: Sequence[float]) -> list[float]:
    """Each probability corrected for how many there are, in the order given."""
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
    """Letters for `names`, best first: two share a letter if and only if they are not `separated`.

    `separated` are the pairs, as sets of two names, that a test has told apart.
    """
    if len(set(names)) != len(names):
        raise StatisticsError(f"a name stands twice in {list(names)}")
    for pair in separated:
        if len(pair) != 2 or not pair <= set(names):
            raise StatisticsError(f"separated pair {sorted(pair)}; allowed: two of {list(names)}")
    columns: list[frozenset[str]] = [frozenset(names)] if names else []
    for one, other in combinations(names, 2):
        if frozenset((one, other)) not in separated:
            continue
        split: list[frozenset[str]] = []
        for column in columns:
            split += [column - {one}, column - {other}] if {one, other} <= column else [column]
        columns = _absorbed(split)
    place = {name: i for i, name in enumerate(names)}
    columns.sort(key=lambda column: sorted(place[name] for name in column))
    return {name: "".join(_letter(i) for i, column in enumerate(columns) if name in column) for name in names}


def _absorbed(columns: list[frozenset[str]]) -> list[frozenset[str]]:
    """Without those that lie within another."""
    kept: list[frozenset[str]] = []
    for column in sorted(set(columns), key=lambda column: (-len(column), sorted(column))):
        if not any(column <= other for other in kept):
            kept.append(column)
    return kept


def _letter(i: int) -> str:
    """a to z, then a1 to z1, a2 and so on: a plan with more groups than letters stays readable."""
    return chr(ord("a") + i % 26) + (str(i // 26) if i >= 26 else "")


def separated_pairs(probabilities: Mapping[frozenset[str], float], alpha: float) -> set[frozenset[str]]:
    """Those pairs whose probability, corrected by Holm for all given, is at most `alpha`."""
    pairs = list(probabilities)
    corrected = holm([probabilities[pair] for pair in pairs])
    return {pair for pair, p in zip(pairs, corrected, strict=True) if p <= alpha}
