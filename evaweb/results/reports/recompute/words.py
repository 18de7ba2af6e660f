"""Check of the sentences in the report's headline and on its page against the recomputed numbers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from .designs import Block, arms_of
from .numbers import Trial
from .page import Node, below, cells_fit, plain

_FROM = 6  # plan format from which reveals record texts


def headline_faults(
    said: Sequence[Mapping[str, Any]], blocks: Sequence[Block], plan: Mapping[str, Any], told: Sequence[str]
) -> list[str]:
    """Return conclusions missing from the headline's sentences, and sentences without a conclusion.

    `said` are the recomputed conclusions, `told` the sentences recorded at the reveal.
    """
    if plan.get("format", 1) < _FROM or not said:
        return []
    left, faults = list(told), []
    for conclusion in said:
        beginnings = list(_ways(conclusion, blocks, plan))
        matching = [sentence for sentence in left if sentence.startswith(tuple(beginnings))]
        if matching:
            left.remove(matching[0])
        else:
            faults.append(f"headline: no sentence begins {' or '.join(map(repr, beginnings))}")
    best = _best(said, plan)
    if best and (matching := [sentence for sentence in left if sentence.startswith(best)]):
        left.remove(matching[0])
    elif best:
        faults.append(f"headline: no sentence begins {best!r}")
    return faults + [f"headline: nothing comes out as {sentence!r}" for sentence in left]


def _ways(conclusion: Mapping[str, Any], blocks: Sequence[Block], plan: Mapping[str, Any]) -> Iterator[str]:
    """Yield the possible beginnings of the headline's sentence on one comparison, including the counts."""
    first, second, stopping = conclusion["first"], conclusion["second"], plan["stopping"]
    if conclusion["at"] is None:
        yield f"{first} and {second} were not compared: closed after {conclusion['blocks']} of "
        yield f"{first} and {second} would not be compared yet after {conclusion['blocks']} of "
        return
    better, worse = (second, first) if conclusion["winner"] == second else (first, second)
    arms, margin = arms_of(plan), stopping.get("margin")
    sides = [
        [value for block in blocks[: conclusion["at"]] for arm, value in block if arms[arm] == name]
        for name in (better, worse)
    ]
    counts = " against ".join(f"{sum(side):.0f}/{len(side)}" for side in sides)
    by_score = stopping.get("outcome") == "score"
    if by_score:
        means = (f"{sum(side) / len(side):.2f}" for side in sides)
        counts = f"mean scores {' and '.join(means)}"
    if margin is not None:
        negation = "" if conclusion["winner"] else "not shown to be "
        yield f"{first} is {negation}not worse than {second} by {100 * margin:g} points or more: {counts}"
    elif conclusion["winner"] is None:
        yield f"No significant difference between {first} and {second}: {counts}"
        yield f"Undecided: {conclusion['at']} {_unit(plan)} cannot tell {first} and {second} apart: {counts}"
    elif not by_score:
        yield f"{better} succeeded more often than {worse}: {counts}"
    elif conclusion["p"] is not None:  # sign-flip tests show only that the two are not exchangeable
        yield f"Scores of {better} and {worse} differ: {counts}"
    else:
        yield f"{better} reached higher scores than {worse}: {counts}"


def _unit(plan: Mapping[str, Any]) -> str:
    return "blocks" if plan["stopping"].get("counts") else "pairs"


def _best(conclusions: Sequence[Mapping[str, Any]], plan: Mapping[str, Any]) -> str:
    """Return the beginning of the headline's sentence on the best of all checkpoints.

    Return "" if the headline must not have such a sentence.
    """
    arms, stopping = arms_of(plan), plan["stopping"]
    of_all = len(arms) > 2 and 2 * len(conclusions) == len(arms) * (len(arms) - 1)
    differ = stopping.get("outcome") == "score" and any(
        conclusion["p"] is not None for conclusion in conclusions
    )
    if (
        not of_all
        or differ
        or stopping.get("margin") is not None
        or any(conclusion["at"] is None for conclusion in conclusions)
    ):
        return ""
    beaten = {
        conclusion["first"] if conclusion["winner"] == conclusion["second"] else conclusion["second"]
        for conclusion in conclusions
        if conclusion["winner"]
    }
    left = [arm for arm in arms if arm not in beaten]
    if len(left) == 1:
        return f"{left[0]} is the best of {len(arms)}"
    if not left:
        return f"No best of {len(arms)} was found"
    return f"No single best of {len(arms)}: "


def page_faults(root: Node, shown: Mapping[str, Any], trials: Sequence[Trial], later: bool) -> list[str]:
    """Return differences of the page's tables from numbers.json and trials.csv.

    If scores came `later` than the reveal, the page may state corrections.
    """
    arms = {row[0]: row[1:] for row in below(root, "Checkpoint", "Groups")}
    faults = []
    for name, arm in shown["arms"].items():
        cells, expected = arms.pop(plain(name), []), _cells(arm)
        letter = shown["letters"].get(name, "")
        if not cells or cells[0] != letter or not cells_fit(cells[1:], expected, later):
            faults.append(
                f"index.html says of {name} {cells or 'nothing'}, numbers.json {[letter, *expected]}"
            )
    faults += [f"index.html has {name} among the checkpoints" for name in arms]
    counted = [trial for trial in trials if trial.status == "scored"]
    rows = {row[0]: row[1:] for row in below(root, "#", "Checkpoint", "Condition")}
    for trial in counted:
        row = rows.pop(str(trial.order), [])
        expected = [plain(trial.checkpoint), plain(trial.condition), "yes" if trial.success else "no"]
        rounded = (trial.score, 2), (trial.duration, 1)
        fits = len(row) > 6 and row[:3] == expected and row[-1] == plain(f"{trial.station}, {trial.operator}")
        if not fits or not all(
            _is_rounded(cell, *value) for cell, value in zip(row[3:5], rounded, strict=True)
        ):
            description = ", ".join(
                map(str, (*expected, trial.score, trial.duration, trial.station, trial.operator))
            )
            faults.append(f"index.html does not say of trial {trial.order}: {description}")
    return faults + [f"index.html has a trial {order}, which does not count" for order in rows]


def _is_rounded(cell: str, value: float | None, digits: int) -> bool:
    """Return True if the cell is the value, rounded to `digits` in any direction."""
    if value is None:
        return cell == ""
    try:
        return abs(float(cell) - value) < 0.5001 * 10.0**-digits
    except ValueError:
        return False


def _cells(arm: Mapping[str, Any]) -> list[str]:
    """Return the expected cells of a checkpoint's row in the table, from the cell that follows its letters."""
    rate = f"{arm['successes']}/{arm['n']}, {100 * arm['rate']:.0f} % [{_ends(arm['wilson'])}]"
    means = (
        f"{100 * arm[name]['value']:.0f} % [{_ends(arm[name]['gaffke'])}]" for name in ("score", "macro")
    )
    smooth = (_average(arm[name], arm["n"]) for name in ("smoothness", "smoothness_commanded"))
    return [rate, f"[{_ends(arm['clopper_pearson'])}]", *means, _time(arm), _speed(arm), *smooth]


def _time(arm: Mapping[str, Any]) -> str:
    mean = (arm.get("time_to_success") or {}).get("restricted_mean")
    if not mean:
        return "–"
    low, high = mean["gaffke"]
    return f"{mean['value_s']:.1f} s [{low:.1f}, {high:.1f}], up to {mean['until_s']:.0f} s"


def _speed(arm: Mapping[str, Any]) -> str:
    rate = arm.get("successes_per_hour")
    if not rate:
        return "–"
    low, high = rate["garwood"]
    return f"{rate['per_hour']:.1f} [{low:.1f}, {high:.1f}]"


def _average(average: Mapping[str, Any] | None, of: int) -> str:
    if not average:
        return "–"
    n = f"n {average['n']}" if average["n"] == of else f"{average['n']} of {of} trials"
    if not average["student"]:
        return f"{_decimal(average['mean'])}, {n}: no interval"
    return f"{_decimal(average['mean'])} [{', '.join(map(_decimal, average['student']))}], {n}"


def _decimal(value: float) -> str:
    return f"{value:.2f}".replace("-", "−")


def _ends(interval: Sequence[float]) -> str:
    return ", ".join(f"{100 * end:.0f}".replace("-0", "0").replace("-", "−") for end in interval)
