"""Conclusions of the plan's design from its trials, and the boundary's exact error, counted in integers."""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Protocol

from . import methods

Pair = tuple[float, float]
Block = Sequence[tuple[int, float]]  # arm and outcome of each trial that counts
_TIE = 1e-9  # relative tolerance: p equals alpha up to its last bits
_EDGE = 1e-9  # distance of rates and differences from the ends of their range
_HALVED = 60


class Row(Protocol):
    """Fields of a trial that this module needs."""

    block: str
    slot: int
    checkpoint: str
    status: str
    success: bool
    score: float


def planned(
    trials: Sequence[Row], plan: Mapping[str, Any], at_reveal: Mapping[str, Any] | None
) -> list[dict[str, Any]]:
    """Return the conclusion of each comparison, from the blocks recorded at the reveal if there was one."""
    return conclusions(recorded_blocks(at_reveal) if at_reveal else blocks_of(trials, plan), plan)


def planned_letters(
    trials: Sequence[Row], plan: Mapping[str, Any], at_reveal: Mapping[str, Any] | None
) -> dict[str, str] | None:
    """Return letters from the plan's comparisons, if it compared all checkpoints with each other and has
    ended; else None.
    """
    names, arms = comparisons_of(plan), arms_of(plan)
    results = planned(trials, plan, at_reveal)
    if (
        len(names) < 3
        or 2 * len(names) != len(arms) * (len(arms) - 1)
        or plan["stopping"].get("margin") is not None
        or any(row["at"] is None for row in results)
    ):
        return None
    blocks = recorded_blocks(at_reveal) if at_reveal else blocks_of(trials, plan)
    rates = {}
    for number, name in enumerate(arms):
        values = [value for block in blocks for arm, value in block if arm == number]
        rates[name] = sum(values) / len(values) if values else 0.0
    ranked = sorted(arms, key=lambda name: (-rates[name], name))
    apart = {frozenset((row["first"], row["second"])) for row in results if row["winner"] is not None}
    return methods.letters(ranked, apart)


def comparisons_of(plan: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the planned comparisons; early plans have at most one."""
    before = [plan["comparison"]] if plan.get("comparison") else []
    return [(first, second) for first, second in plan.get("comparisons", before)]


def arms_of(plan: Mapping[str, Any]) -> list[str]:
    """Return the compared checkpoints in the order in which the comparisons name them."""
    return list(dict.fromkeys(name for names in comparisons_of(plan) for name in names))


def recorded_blocks(at_reveal: Mapping[str, Any]) -> list[Block]:
    """Return the blocks recorded at a reveal; early reveals recorded pairs."""
    if "blocks" in at_reveal:
        return [[(arm, float(value)) for arm, value in block] for block in at_reveal["blocks"]]
    return [[(0, float(first)), (1, float(second))] for first, second in at_reveal["pairs"]]


def blocks_of(trials: Sequence[Row], plan: Mapping[str, Any]) -> list[Block]:
    """Return outcomes of the compared checkpoints by block, in the schedule's order.

    The list ends with the last block that the conclusion of a comparison uses.
    """
    arms, by_score = arms_of(plan), plan["stopping"].get("outcome") == "score"
    blocks: dict[int, dict[int, tuple[int, float]]] = defaultdict(dict)
    for trial in trials:
        if trial.status == "scored" and trial.checkpoint in arms:
            value = trial.score if by_score else float(trial.success)
            blocks[int(trial.block)][int(trial.slot)] = (arms.index(trial.checkpoint), value)
    whole = [[of for _, of in sorted(blocks.get(at, {}).items())] for at in range(_foreseen(plan))]
    used = max((row["blocks"] for row in conclusions(whole, plan)), default=0)
    return list(whole[:used])


def record_contradictions(
    rows: Sequence[Mapping[str, str]],
    scores: Sequence[Mapping[str, str]],
    plan: Mapping[str, Any],
    at_reveal: Mapping[str, Any] | None,
) -> list[str]:
    """Return contradictions between trials, scores, and the blocks recorded at the reveal."""
    by_trial: dict[str, list[Mapping[str, str]]] = defaultdict(list)
    for score in scores:
        by_trial[score["trial"]].append(score)
    trials = {row["trial"] for row in rows}
    sentences = [
        f"scores.csv has a score of trial {trial}, trials.csv no such trial"
        for trial in by_trial
        if trial not in trials
    ]
    for row in rows:
        newest = by_trial[row["trial"]][-1] if by_trial[row["trial"]] else {}
        own, stored = (
            [_plain(of.get(name, "")) for name in ("success", "score", "milestones")] for of in (row, newest)
        )
        if own != stored and (newest or row["status"] == "scored"):
            sentences.append(f"trial {row['trial']} is said to be {own}, its newest score is {stored}")
    if at_reveal is not None and not sentences:
        stood = [_stood(row, by_trial, at_reveal["at"]) for row in rows]
        stored, blocks_then = recorded_blocks(at_reveal), blocks_of(stood, plan)
        # Compared without the order within a block: reveals that recorded pairs did not record it.
        if [sorted(block) for block in stored] != [sorted(block) for block in blocks_then]:
            sentences.append("the blocks of the reveal are not those of the scores that stood then")
        sentences += [
            f"the sums of {arm['checkpoint']} at the reveal are not those of the scores that stood then"
            for arm in at_reveal.get("arms", ())  # recorded only by later formats
            if not _adds_up(arm, [row for row in stood if row.status and row.checkpoint == arm["checkpoint"]])
        ]
    return sentences


def _adds_up(arm: Mapping[str, Any], rows: Sequence[_Stood]) -> bool:
    if (arm["n"], arm["successes"]) != (len(rows), sum(row.success for row in rows)):
        return False
    return not rows or abs(arm["score"] - sum(row.score for row in rows) / len(rows)) < 1e-9


@dataclass(frozen=True)
class _Stood:
    block: str
    slot: int
    checkpoint: str
    status: str
    success: bool
    score: float


def _stood(row: Mapping[str, str], by_trial: Mapping[str, Sequence[Mapping[str, str]]], at: str) -> _Stood:
    """Return the trial as it was at the time `at`, with the last score given by then.

    A trial without a score at that time does not count.
    """
    then = datetime.fromisoformat(at)
    before = [score for score in by_trial[row["trial"]] if datetime.fromisoformat(score["scored_at"]) <= then]
    counts = row["status"] == "scored" and bool(before)
    success, score = (before[-1]["success"] == "true", float(before[-1]["score"])) if counts else (False, 0.0)
    slot = int(row["slot"])
    return _Stood(row["block"], slot, row["checkpoint"], "scored" if counts else "", success, score)


def _plain(cell: str) -> Any:
    """Return the cell parsed as JSON, so that equal numbers and lists compare equal; its text if it is not JSON."""
    try:
        return json.loads(cell)
    except ValueError:
        return cell


def conclusions(blocks: Sequence[Block], plan: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return for each comparison its number of blocks, the block of its end, and its winner.

    For a fixed number of trials it also has the p-value of the test. If checkpoints are dropped, comparisons are
    decided block by block: the first to end in the schedule's order decides which checkpoints remain.
    """
    names, arms = comparisons_of(plan), arms_of(plan)
    sides = [(arms.index(first), arms.index(second)) for first, second in names]
    foreseen = _foreseen(plan)
    used = blocks[:foreseen]
    by_number: dict[int, dict[str, Any]] = {}
    if not plan["stopping"].get("drops"):
        by_number = {n: _conclusion(used, plan, pair) for n, pair in enumerate(sides)}
        if plan.get("format", 1) >= 6 and all(row["p"] is not None for row in by_number.values()):
            _step_by_step(by_number, used, plan, sides)
    dropped: dict[int, int] = {}
    # With a margin no arm is found worse; a control, which is in all comparisons, always stays.
    margin = plan["stopping"].get("margin") is not None
    spared = {arm for arm in range(len(arms)) if margin or all(arm in pair for pair in sides)}
    while len(by_number) < len(sides):
        complete = list(used)
        for number, block in enumerate(used):
            needed = {arm for arm in range(len(arms)) if dropped.get(arm, foreseen) > number}
            if not needed <= {arm for arm, _ in block}:
                complete = list(used[:number])
                break
        left = {n: _conclusion(complete, plan, pair) for n, pair in enumerate(sides) if n not in by_number}
        ends = [row["at"] for row in left.values() if row["winner"] is not None]
        if not ends:
            by_number |= left
            break
        at = min(ends)
        for n, row in left.items():
            if row["winner"] is not None and row["at"] == at:
                by_number[n] = {**row, "blocks": at}
        worse = {
            sides[n][1 - row["winner"]] for n, row in by_number.items() if n in left and row["at"] == at
        } - spared
        for n in left:
            if n not in by_number and worse & {*sides[n]}:
                by_number[n] = {"blocks": at, "at": at, "winner": None, "p": None, "estimate": None}
        still = {arm for n, pair in enumerate(sides) if n not in by_number for arm in pair}
        dropped |= {arm: at for arm in range(len(arms)) if arm not in still and arm not in dropped}
    return [
        {
            "first": first,
            "second": second,
            **by_number[n],
            "winner": None if by_number[n]["winner"] is None else (first, second)[by_number[n]["winner"]],
        }
        for n, (first, second) in enumerate(names)
    ]


def _step_by_step(
    by_number: dict[int, dict[str, Any]],
    blocks: Sequence[Block],
    plan: Mapping[str, Any],
    sides: Sequence[tuple[int, int]],
) -> None:
    """Apply Holm's procedure: smallest p at alpha over all comparisons, the next at alpha over the remaining
    ones, and so on.
    """
    ranked = sorted(by_number, key=lambda n: by_number[n]["p"])
    for left, n in zip(range(len(ranked), 0, -1), ranked, strict=True):
        if by_number[n]["p"] > plan["stopping"]["alpha"] / left * (1 + _TIE):
            break
        first, second = (_side_mean(blocks, plan, side) for side in sides[n])
        by_number[n]["winner"] = int(first <= second)


def _side_mean(blocks: Sequence[Block], plan: Mapping[str, Any], arm: int) -> float:
    values = [value for block in blocks for number, value in block if number == arm]
    return math.fsum(values) / len(values)


def _conclusion(blocks: Sequence[Block], plan: Mapping[str, Any], sides: tuple[int, int]) -> dict[str, Any]:
    """Return the conclusion of one comparison; `winner` is 0 (first of `sides`), 1 (second) or None."""
    stopping = plan["stopping"]
    foreseen, alpha, margin = _foreseen(plan), share_of(plan), stopping.get("margin")
    complete = _complete_blocks(blocks, stopping.get("counts"), sides)
    at, winner, p = len(complete) if len(complete) == foreseen else None, None, None
    difference = None
    if stopping.get("boundary"):
        tables = {(table[0], table[1]): table for table in stopping["boundary"]}
        for number in range(1, len(complete) + 1):
            (first, n), (second, m) = (_sum(complete[:number], side) for side in (0, 1))
            table = tables.get((n, m) if margin is None else (m, n))
            side = None if table is None else _side(table, first, second, margin)
            if side is not None:
                at, winner = number, side
                break
        if at is not None and margin is None:
            (first, n), (second, m) = (_sum(complete[:at], side) for side in (0, 1))
            difference = estimate(stopping["boundary"], int(first), n, int(second), m)
    elif stopping["rule"] == "evidence":
        at, winner = _evidence([(x[0], y[0]) for x, y in complete], stopping, alpha, at)
    elif at is not None:
        (first, n), (second, m) = (_sum(complete, side) for side in (0, 1))
        if stopping.get("outcome") == "score":
            p = methods.sign_flips([x[0] - y[0] for x, y in complete])
        else:
            p = methods.barnard(int(first), n, int(second), m)[1] if n and m else 1.0
        winner = int(first * m <= second * n) if p <= alpha * (1 + _TIE) else None
    return {
        "blocks": len(complete),
        "at": at,
        "winner": winner,
        "p": p,
        "estimate": difference and list(difference),
    }


def _complete_blocks(
    blocks: Sequence[Block], counts: Sequence[Sequence[int]] | None, sides: tuple[int, int]
) -> list[tuple[list[float], list[float]]]:
    """Return the outcomes of the two checkpoints in `sides`, one pair of lists per block.

    The first incomplete block and all later ones are left out. `counts` contains, for the end of each block, how many
    trials of each of the two checkpoints the schedule has up to there. If it is None, each block has one trial of each.
    """
    complete: list[tuple[list[float], list[float]]] = []
    before = [0, 0]
    for number, block in enumerate(blocks):
        left, right = ([value for arm, value in block if arm == side] for side in sides)
        after = list(counts[number]) if counts else [number + 1, number + 1]
        if [before[0] + len(left), before[1] + len(right)] != after:
            break
        before = after
        complete.append((left, right))
    return complete


def _sum(blocks: Sequence[tuple[list[float], list[float]]], side: int) -> tuple[float, int]:
    values = [value for block in blocks for value in block[side]]
    return sum(values), len(values)


def error(plan: Mapping[str, Any]) -> float:
    """Return an upper bound of the probability that the boundary stops wrongly.

    For a design with a margin, it is the maximum over 400 rates. All orders of outcomes that lead to a table are
    equally likely, and their number is counted exactly.
    """
    stopping = plan["stopping"]
    margin, alpha = stopping.get("margin"), share_of(plan)
    if margin is not None:
        return _with_margin(list(_stopped(stopping["boundary"], margin)), margin)
    gone, trials = [0], 0  # number of stopped orders by total successes
    for n, m, tables in _stopped(stopping["boundary"], margin):
        for _ in range(n + m - trials):
            gone = [left + right for left, right in zip([*gone, 0], [0, *gone], strict=True)]
        trials = n + m
        for (a, b), number in tables.items():
            gone[a + b] += number
    share = [number / math.comb(trials, x) for x, number in enumerate(gone)]
    return _bound(share, alpha)


def share_of(plan: Mapping[str, Any]) -> float:
    """Return the error probability of a single comparison: alpha divided by the number of comparisons."""
    return float(plan["stopping"]["alpha"]) / max(1, len(comparisons_of(plan)))


def _bound(share: Sequence[float], alpha: float) -> float:
    """Return an upper bound of the mean of `share`, valid at any success rate.

    The mean is over the binomial number of successes, which is the index of `share`. Rate and mean are both expressed
    as sin(angle)^2. The mean's angle then changes by at most sqrt(trials) per radian of the rate's angle. This limits
    the mean between the points of a grid of rates. An interval whose bound exceeds alpha is bisected, down to the
    numerical resolution.
    """
    turn, allowed, end = math.sqrt(len(share) - 1), math.asin(math.sqrt(alpha)), 1e-7

    def turned(angle: float) -> float:
        return math.asin(math.sqrt(min(1.0, max(0.0, _mixed(share, math.sin(angle) ** 2)))))

    angles = [end + (math.pi / 2 - 2 * end) * i / 1000 for i in range(1001)]
    at = [turned(angle) for angle in angles]
    cells = list(zip(angles, angles[1:], at, at[1:], strict=False))
    bound = max(at[0], at[-1]) + turn * end
    while cells:
        left, right, low, high = cells.pop()
        most = (low + high + turn * (right - left)) / 2
        if most <= allowed or max(low, high) > allowed or right - left < 1e-9:
            bound = max(bound, most)
        else:
            middle = (left + right) / 2
            at_middle = turned(middle)
            cells += [(left, middle, low, at_middle), (middle, right, at_middle, high)]
    return math.sin(min(bound, math.pi / 2)) ** 2


def _foreseen(plan: Mapping[str, Any]) -> int:
    return int(sum(len(scene["positions"]) for scene in plan["scenes"]) * plan["repetitions"])


def _side(table: Sequence[int], first: float, second: float, margin: float | None) -> int | None:
    """Return the side (0 or 1) for which the boundary stops at a look; None if it does not stop.

    `table` is the boundary's row of that look, `first` and `second` are the successes of the first and the second
    checkpoint.
    """
    n, m, *least = table
    if margin is not None:  # with a margin it tests its second arm: the first checkpoint
        first, second = second, first
    if not least or not _reaches((int(first), n, int(second), m), (least[0], n, least[1], m), margin):
        return None
    return 0 if margin is not None or first * m > second * n else 1


def _reaches(
    table: tuple[int, int, int, int], least: tuple[int, int, int, int], margin: float | None
) -> bool:
    own, limit = _degree(*table, margin), _degree(*least, margin)
    return own[0] * limit[1] >= limit[0] * own[1]


def _degree(a: int, n: int, b: int, m: int, margin: float | None) -> tuple[int, int]:
    """Return how extreme a table with `a` of `n` and `b` of `m` successes is, as a fraction (numerator, denominator).

    It is the squared pooled statistic; with a margin the signed square of Agresti and Caffo's statistic.
    """
    if margin is None:
        x, failures = a + b, n + m - a - b
        return ((a * m - b * n) ** 2, x * failures) if x and failures else (0, 1)
    a, b, n, m, scale = a + 1, b + 1, n + 2, m + 2, 10**9
    lead = (b * n - a * m) * scale + round(margin * scale) * n * m
    return lead * abs(lead) * n * m, (a * (n - a) * m**3 + b * (m - b) * n**3) * scale**2


Tables = dict[tuple[int, int], int]  # successes of both arms: number of orders that lead to them


def _stopped(boundary: Sequence[Sequence[int]], margin: float | None) -> Iterator[tuple[int, int, Tables]]:
    """Yield, for each look of the boundary, the trials of both arms and the tables that end the comparison there."""
    yield from ((n, m, gone) for n, m, gone, _ in _walked(boundary, margin))


def _walked(
    boundary: Sequence[Sequence[int]], margin: float | None
) -> Iterator[tuple[int, int, Tables, Tables]]:
    """Yield, for each look, the trials of both arms, the tables that end the comparison, and the other tables."""
    alive, n, m = {(0, 0): 1}, 0, 0
    for limit in boundary:
        for arm in (0,) * (limit[0] - n) + (1,) * (limit[1] - m):
            grown: dict[tuple[int, int], int] = defaultdict(int)
            for (a, b), number in alive.items():
                grown[a, b] += number
                grown[(a + 1, b) if arm == 0 else (a, b + 1)] += number
            alive = grown
        n, m, *least = limit
        gone = [
            (a, b) for a, b in alive if least and _reaches((a, n, b, m), (least[0], n, least[1], m), margin)
        ]
        yield n, m, {table: alive.pop(table) for table in gone}, alive


def _mixed(share: Sequence[float], p: float) -> float:
    """Return the mean of `share` [n + 1] if the number of successes is binomial with `n` trials and rate `p`.

    `share` has one value for each number of successes, 0 to n.
    """
    n = len(share) - 1
    middle = min(n, int(p * (n + 1)))
    at = math.exp(
        math.lgamma(n + 1)
        - math.lgamma(middle + 1)
        - math.lgamma(n - middle + 1)
        + middle * math.log(p)
        + (n - middle) * math.log1p(-p)
    )
    odds, total, mass = p / (1 - p), at * share[middle], at
    for x in range(middle + 1, n + 1):
        mass *= odds * (n - x + 1) / x
        total += mass * share[x]
        if mass < 1e-18:
            break
    mass = at
    for x in range(middle, 0, -1):
        mass *= x / (n - x + 1) / odds
        total += mass * share[x - 1]
        if mass < 1e-18:
            break
    return total


def _with_margin(stopped: Sequence[tuple[int, int, dict[tuple[int, int], int]]], margin: float) -> float:
    cells = [
        (math.log(log_number), a, n - a, b, m - b)
        for n, m, tables in stopped
        for (a, b), log_number in tables.items()
    ]
    highest = 0.0
    for i in range(1, 401):
        high = math.sin(math.pi / 2 * i / 401) ** 2
        p, q = margin + (1 - margin) * high, (1 - margin) * high
        won, lost, other_won, other_lost = (math.log(rate) for rate in (p, 1 - p, q, 1 - q))
        highest = max(
            highest,
            math.fsum(
                math.exp(log_number + a * won + not_a * lost + b * other_won + not_b * other_lost)
                for log_number, a, not_a, b, not_b in cells
            ),
        )
    return highest


def _evidence(
    pairs: Sequence[Pair], stopping: Mapping[str, Any], alpha: float, full: int | None
) -> tuple[int | None, int | None]:
    if stopping.get("outcome") == "score":
        paths = [methods.score_bets([sign * (a - b) for a, b in pairs]) for sign in (1, -1)]
    else:
        paths = [
            methods.success_bets([(bool(pair[1 - side]), bool(pair[side])) for pair in pairs])
            for side in (0, 1)
        ]
    threshold = math.log(2 / alpha)
    for number, worth in enumerate(zip(*paths, strict=True), start=1):
        if max(worth) >= threshold:
            return number, worth.index(max(worth))
    return full, None


def estimate(
    boundary: Sequence[Sequence[int]], first: int, n: int, second: int, m: int
) -> tuple[float, float, float] | None:
    """Return the median-unbiased difference of rates and its 95 % interval, by the stagewise order.

    None if the boundary has no look at these numbers of trials, `n` and `m`.
    """
    beyond: list[tuple[float, ...]] = []
    same: list[tuple[float, ...]] = []
    sizes = [(table[0], table[1]) for table in boundary]
    if (n, m) not in sizes:
        return None
    side = _side(boundary[sizes.index((n, m))], first, second, None)
    mirrored = side == 1
    observed = first * m - second * n
    for at_n, at_m, stopped, left in _walked(boundary, None):
        last = (at_n, at_m) == (n, m)
        for tables, stops in ((stopped, True), (left, False)):
            if not stops and not last:
                continue
            for (a, b), number in tables.items():
                lead = a * at_m - b * at_n
                row = (a, at_n - a, b, at_m - b, math.log(number))
                for_it = lead < 0 if mirrored else lead > 0
                farther = lead < observed if mirrored else lead > observed
                if last and (side is None) != stops and lead == observed and (side is None or for_it):
                    same.append(row)
                elif (stops and for_it and (not last or side is None or farther)) or (
                    last and side is None and not stops and farther
                ):
                    beyond.append(row)
        if last:
            break

    def chances(difference: float) -> tuple[float, float]:
        p, q = _likeliest(difference, first, n, second, m)
        logs = (math.log(p), math.log(1 - p), math.log(q), math.log(1 - q))
        outside, alike = (
            math.fsum(
                math.exp(row[4] + sum(x * log for x, log in zip(row, logs, strict=False))) for row in rows
            )
            for rows in (beyond, same)
        )
        return (1 - outside - alike if mirrored else outside), alike

    values = []
    for target, share in ((0.5, 0.5), (0.025, 1.0), (0.975, 0.0)):
        low, high = -1.0 + _EDGE, 1.0 - _EDGE
        for _ in range(_HALVED):
            middle = (low + high) / 2
            more, alike = chances(middle)
            low, high = (middle, high) if more + share * alike < target else (low, middle)
        values.append((low + high) / 2)
    return values[0], values[1], values[2]


def _likeliest(difference: float, first: int, n: int, second: int, m: int) -> tuple[float, float]:
    """Return the rates with this difference that maximise the likelihood."""
    low, high = max(0.0, -difference) + _EDGE / 4, min(1.0, 1.0 - difference) - _EDGE / 4
    for _ in range(_HALVED):
        q = (low + high) / 2
        p = q + difference
        slope = first / p - (n - first) / (1 - p) + second / q - (m - second) / (1 - q)
        low, high = (q, high) if slope > 0 else (low, q)
    q = (low + high) / 2
    return _inside(q + difference), _inside(q)


def _inside(rate: float) -> float:
    return min(max(rate, _EDGE / 8), math.nextafter(1.0, 0.0) - _EDGE / 8)
