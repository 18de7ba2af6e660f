"""Statistics of raters, automatic judges and preferences: agreement, calibration, Bradley-Terry by Newton's method."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations
from typing import Any

from . import methods

_FAR = 30.0  # size of log-worths that indicates a likelihood without maximum


def agreement(pairs: Sequence[tuple[bool, bool]]) -> dict[str, Any]:
    """Return the agreement of two raters on yes/no pairs."""
    n, same = len(pairs), sum(first == second for first, second in pairs)
    observed = same / n
    yes = [sum(pair[i] for pair in pairs) / n for i in (0, 1)]
    by_chance = yes[0] * yes[1] + (1 - yes[0]) * (1 - yes[1])
    share = sum(yes) / 2
    gwet = 2 * share * (1 - share)
    ones, m = n * sum(yes), 2 * n
    # Krippendorff: disagreement expected for all values pooled, drawn without replacement.
    expected = 2 * ones * (m - ones) / (m * (m - 1))
    one_word = sum(yes) in (0.0, 2.0)  # all ratings are equal: chance agreement is undefined
    return {
        "n": n,
        "same": same,
        "wilson": methods.wilson(same, n),
        "kappa": None if one_word else 1.0 if same == n else (observed - by_chance) / (1 - by_chance),
        "ac1": 1.0 if same == n else (observed - gwet) / (1 - gwet),
        "alpha": None if one_word else 1.0 if same == n else 1 - (1 - observed) / expected,
    }


def calibration(pairs: Sequence[tuple[float, bool]]) -> dict[str, Any] | None:
    """Return the calibration of (probability, outcome) pairs in tenths."""
    if not pairs:
        return None
    tenths: dict[int, list[tuple[float, bool]]] = {}
    for pair in pairs:
        tenths.setdefault(sum(pair[0] >= k / 10 for k in range(1, 10)), []).append(pair)
    n, bins, gaps = len(pairs), [], 0.0
    for k, members in sorted(tenths.items()):
        mean, true = sum(p for p, _ in members) / len(members), sum(so for _, so in members)
        gaps += len(members) / n * abs(mean - true / len(members))
        edges = {"low": k / 10, "high": (k + 1) / 10}
        bins.append({**edges, "n": len(members), "probability": mean, "true": true})
    brier = math.fsum((1 - p) ** 2 if so else p * p for p, so in pairs) / n
    return {"n": n, "brier": brier, "error": gaps, "bins": bins}


def on_milestone(said: Sequence[tuple[bool, bool | None, float | None]]) -> dict[str, Any]:
    """Return a judge's agreement with the scores on one milestone, and the Brier score of its probabilities.

    `said` has for each trial the score, the judge's verdict and its probability; both are None if it gave no verdict.
    """
    pairs = [(scored, reached) for scored, reached, _ in said if reached is not None]
    calibrated = calibration([(p, scored) for scored, _, p in said if p is not None])
    return {
        "no_verdict": len(said) - len(pairs),
        "agreement": agreement(pairs) if pairs else None,
        "brier": calibrated and calibrated["brier"],
    }


def score_alpha(pairs: Sequence[tuple[float, float]]) -> float | None:
    """Return Krippendorff's alpha of scores with squared differences; None if all are equal."""
    observed = sum((a - b) ** 2 for a, b in pairs) / len(pairs)
    values = [value for pair in pairs for value in pair]
    n = len(values)
    expected = sum((a - b) ** 2 for a in values for b in values) / (n * (n - 1))
    return 1 - observed / expected if expected else None


def by_text(milestones: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    """Return a dict from each milestone's text to its value; a repeated text is numbered in order: "held (2)"."""
    by_label: dict[str, Any] = {}
    for text, value in milestones:
        label, n = text, 1
        while label in by_label:
            n += 1
            label = f"{text} ({n})"
        by_label[label] = value
    return by_label


def preferences(rows: Sequence[tuple[str, str, str, float]]) -> dict[str, Any] | None:
    """Return the ranking of the checkpoints by preferences, with the number of preferences and of ties.

    Each row is one preference: (first checkpoint, second checkpoint, outcome, weight). If the likelihood has no
    maximum, key "ranking" is None. The result is None if no row compares two different checkpoints.
    """
    rows = [row for row in rows if row[0] != row[1]]
    if not rows:
        return None
    counted = {"n": len(rows), "ties": sum(row[2] == "tie" for row in rows)}
    fitted = _fitted(rows, True) or _fitted(rows, False)
    if fitted is None:
        return {**counted, "ranking": None, "contrasts": [], "tie": None, "order": None, "order_z": None}
    return {**counted, **fitted}


def _fitted(rows: Sequence[tuple[str, str, str, float]], order: bool) -> dict[str, Any] | None:
    names = sorted({name for row in rows for name in row[:2]})
    ties = any(row[2] == "tie" for row in rows)
    k, size = len(names), len(names) - 1 + ties + order
    cells: dict[tuple[str, str, str], float] = defaultdict(float)
    for first, second, outcome, weight in rows:
        cells[first, second, outcome] += weight
    compared = sorted({row[:2] for row in rows})
    kinds = ("first", "second", "tie") if ties else ("first", "second")

    def vector(first: str, second: str, kind: str) -> list[float]:
        v = [0.0] * size
        for name, weight in ((first, (1, 0, 0.5)), (second, (0, 1, 0.5))):
            at = names.index(name) - 1
            if at >= 0:
                v[at] += weight[("first", "second", "tie").index(kind)]
        if kind == "tie":
            v[k - 1] = 1.0
        elif order:
            v[-1] = 0.5 if kind == "first" else -0.5
        return v

    design = [
        [(vector(*pair, kind), cells[*pair, kind], math.log(2) if kind == "tie" else 0.0) for kind in kinds]
        for pair in compared
    ]
    x = [0.0] * size
    for _ in range(200):
        gradient, information = _slopes(design, x)
        try:
            inverse = _inverse(information)
        except ZeroDivisionError:
            return None
        if max(map(abs, gradient)) < 1e-10:
            return _said(names, x, inverse, ties, order)
        step = [sum(a * b for a, b in zip(row, gradient, strict=True)) for row in inverse]
        length = min(1.0, 2.0 / max(map(abs, step)))
        x = [a + length * b for a, b in zip(x, step, strict=True)]
        if max(map(abs, x)) > _FAR:
            return None
    return None


_Design = Sequence[Sequence[tuple[list[float], float, float]]]


def _slopes(design: _Design, x: Sequence[float]) -> tuple[list[float], list[list[float]]]:
    size = len(x)
    gradient = [0.0] * size
    information = [[0.0] * size for _ in range(size)]
    for cell in design:
        weights = [math.exp(offset + sum(a * b for a, b in zip(v, x, strict=True))) for v, _, offset in cell]
        n, total = sum(count for _, count, _ in cell), sum(weights)
        p = [weight / total for weight in weights]
        mean = [sum(q * v[i] for q, (v, _, _) in zip(p, cell, strict=True)) for i in range(size)]
        for i in range(size):
            gradient[i] += sum(count * v[i] for v, count, _ in cell) - n * mean[i]
            for j in range(size):
                second = sum(q * v[i] * v[j] for q, (v, _, _) in zip(p, cell, strict=True))
                information[i][j] += n * (second - mean[i] * mean[j])
    return gradient, information


def _inverse(matrix: Sequence[Sequence[float]]) -> list[list[float]]:
    """Return the inverse by Gauss-Jordan elimination.

    Raises:
        ZeroDivisionError: If the matrix is singular.
    """
    n = len(matrix)
    rows = [[*row, *(float(i == j) for j in range(n))] for i, row in enumerate(matrix)]
    for i in range(n):
        best = max(range(i, n), key=lambda r: abs(rows[r][i]))
        rows[i], rows[best] = rows[best], rows[i]
        if abs(rows[i][i]) < 1e-9:
            raise ZeroDivisionError
        rows[i] = [value / rows[i][i] for value in rows[i]]
        for r in range(n):
            if r != i:
                rows[r] = [a - rows[r][i] * b for a, b in zip(rows[r], rows[i], strict=True)]
    return [row[n:] for row in rows]


def _said(
    names: Sequence[str], x: Sequence[float], inverse: Sequence[Sequence[float]], ties: bool, order: bool
) -> dict[str, Any]:
    k = len(names)
    theta = [0.0, *x[: k - 1]]
    spread = [[0.0] * k for _ in range(k)]
    for i in range(1, k):
        for j in range(1, k):
            spread[i][j] = inverse[i - 1][j - 1]
    middle = sum(theta) / k
    means = [sum(row) / k for row in spread]
    whole = sum(means) / k
    worth = {name: t - middle for name, t in zip(names, theta, strict=True)}
    error = {name: math.sqrt(spread[i][i] - 2 * means[i] + whole) for i, name in enumerate(names)}
    contrasts = []
    for (i, first), (j, second) in combinations(enumerate(names), 2):
        gap, half = theta[i] - theta[j], methods.Z * math.sqrt(spread[i][i] + spread[j][j] - 2 * spread[i][j])
        contrasts.append(
            {
                "first": first,
                "second": second,
                "difference": gap,
                "win_probability": _logistic(gap),
                "interval": [_logistic(gap - half), _logistic(gap + half)],
            }
        )
    ranking: list[Mapping[str, Any]] = [
        {"checkpoint": name, "worth": worth[name], "error": error[name], "rating": 1500 + 200 * worth[name]}
        for name in sorted(names, key=lambda name: (-round(worth[name], 6), name))
    ]
    return {
        "ranking": ranking,
        "contrasts": contrasts,
        "tie": math.exp(x[k - 1]) if ties else None,
        "order": x[-1] if order else None,
        "order_z": x[-1] / math.sqrt(inverse[-1][-1]) if order else None,
    }


def _logistic(value: float) -> float:
    return 1 / (1 + math.exp(-value))
