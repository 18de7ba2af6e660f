"""Recomputes every number of this report and prints those that differ.

Exit code: 0 if all agree, 1 if one differs. It is 2 if all agree, but the plan's key is not revealed: it can then not
be excluded that the data were rewritten consistently.
"""

from __future__ import annotations

import csv
import json
import math
import os
import sys
from collections import Counter
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

from .designs import error, planned, planned_letters, record_contradictions, recorded_blocks, share_of
from .judged import agreement, by_text, calibration, on_milestone, preferences, score_alpha
from .numbers import Drawn, Trial, numbers
from .page import page_contradictions, read
from .record import changes, gaps
from .scenes import ending_faults, scene_faults
from .sealed import faults
from .words import headline_faults, page_faults

_SHOWN = 40
_DECLARED = ("estop", "interruption", "declared")
_TABLES = ("trials", "scores", "ratings", "preferences", "judgements", "laid_out")
_FILES = {f"{name}.json" for name in ("plan", "seal", "numbers", "integrity")} | {
    f"{name}.csv" for name in _TABLES
}
_FILES |= {"pictures"}
_CLOSE = 1e-6  # relative tolerance: sums in different order differ in their last bits
_FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n", "＝", "＋", "－", "＠")  # prefixes that the export escapes
Rows = list[dict[str, str]]
_BROKEN = (  # errors of malformed cells and numbers
    *(ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError, csv.Error),
)
_TAIL = 0.015  # tolerance of the 2.5 % of new draws beyond an interval's end: six standard errors


def main() -> int:
    """Compare data, page and recomputed numbers; print differences and return the exit code."""
    data = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parents[1] / "data"
    plan, seal, shown_numbers, record = (
        json.loads((data / f"{name}.json").read_text("utf-8"), object_pairs_hook=_once)
        for name in ("plan", "seal", "numbers", "integrity")
    )
    rows, scores, ratings, preferred, judgements = (
        _rows(data / f"{name}.csv") for name in ("trials", "scores", "ratings", "preferences", "judgements")
    )
    styles = Path(__file__).with_name("page.css")
    page, hidden = read(
        (data.parent / "index.html").read_text("utf-8"),
        styles.read_text("utf-8") if styles.exists() else None,
    )
    judged = {"ratings": ratings, "preferences": preferred, "judgements": judgements}
    wrong = [
        *hidden,
        *(f"data/{name} is no part of a report" for name in sorted(_names(data) - _FILES)),
        *page_contradictions(page, seal, plan, shown_numbers),
        *faults(seal, plan, rows),
        *gaps(rows, scores, record),
        *changes(rows, scores, judged, seal, record),
        *record_contradictions(rows, scores, plan, seal["at_reveal"]),
        *_boundary(plan),
    ]
    result = {}
    try:
        trials = [_trial(row) for row in _as_revealed(rows, scores, seal["at_reveal"])]
        wrong += [*scene_faults(plan, rows, scores, ratings), *ending_faults(plan, rows)]
        people = Counter(map(_of, preferred))
        conclusions = planned(trials, plan, seal["at_reveal"])
        if seal["at_reveal"]:
            blocks, headline = recorded_blocks(seal["at_reveal"]), seal["at_reveal"].get("headline", ())
            wrong += headline_faults(conclusions, blocks, plan, headline)
        wrong += page_faults(page, shown_numbers, trials, _later(scores, seal["at_reveal"]))
        result = numbers(trials, plan, conclusions)
        result |= {
            "letters": planned_letters(trials, plan, seal["at_reveal"]) or result["letters"],
            "planned": conclusions,
            "agreement": _agreement(rows, scores, ratings),
            "judges": _judges(rows, scores, judgements),
            "preferences": preferences(
                [
                    (row["first_checkpoint"], row["second_checkpoint"], row["outcome"], 1 / people[_of(row)])
                    for row in preferred
                ]
            ),
        }
    except _BROKEN as fault:
        wrong.append(f"the files in data/ contradict each other, no number follows: {fault!r}")
    count = 0
    for where, problem in differences(shown_numbers, result, ""):
        count += 1
        if problem:
            wrong.append(f"{where}: {problem}")
    for line in wrong[:_SHOWN]:
        print(line)
    if len(wrong) > _SHOWN:
        print(f"and {len(wrong) - _SHOWN} others")
    for line in statement(seal, plan, shown_numbers, record):
        print(line)
    sealing = "with its key, schedule and codes" if seal["key"] else "by its digest"
    print(f"frozen under the commitment {seal['commitment']}: hold it against what was published then")
    if seal["at_reveal"]:
        digest = seal["at_reveal"]["digest"]
        print(f"kept at the reveal under the digest {digest}: hold it against what was published then")
    print(f"{count} numbers from {len(rows)} trials, and the plan {sealing}: {len(wrong)} do not come out")
    if wrong:
        return 1
    if not seal["key"]:
        print(
            "NOT REVEALED: nothing ties plan and scores to what was published before; all of it could be rewritten"
        )
    return 0 if seal["key"] else 2


def statement(
    seal: dict[str, Any], plan: dict[str, Any], shown: dict[str, Any], record: dict[str, Any]
) -> Iterator[str]:
    """Yield lines that state the result as the data give it, independently of the report's page."""
    reveal = seal["at_reveal"] or {}
    yield f"What follows from data/, of {plan['title']} v{plan['version']}, {plan['stopping']['rule']}:"
    for sentence in (*reveal.get("headline", ()), reveal.get("setting", "")):
        yield f"  {sentence}" if sentence else "  (no comparison was decided)"
    for name, arm in shown["arms"].items():
        low, high = (100 * end for end in arm["wilson"])
        yield f"  {name}: {arm['successes']} of {arm['n']}, 95 % Wilson {low:.0f} to {high:.0f} %"
    for row in record.get("checkpoints", ()):
        counts = (
            "voided",
            "repeated",
            "interrupted",
            "abandoned",
            "to_success",
            "to_failure",
            "late",
            *_DECLARED,
        )
        events = [f"{row[name]} {name.replace('_', ' ')}" for name in counts if row.get(name)]
        if events:
            yield f"  {row['checkpoint']}: {row['attempts']} attempts, {', '.join(events)}"
    for sentence in reveal.get("caveats", ()):
        yield f"  doubt: {sentence}"


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a JSON object; raise ValueError if a key occurs twice."""
    values = dict(pairs)
    if len(values) < len(pairs):
        raise ValueError(f"a key stands twice in {sorted(values)[:3]} ...")
    return values


def _names(data: Path) -> set[str]:
    return {path.name for path in data.iterdir()}


def _later(scores: Rows, at_reveal: dict[str, Any] | None) -> bool:
    """Return True if scores were given after the reveal."""
    if not at_reveal:
        return False
    then = datetime.fromisoformat(at_reveal["at"])
    return any(datetime.fromisoformat(score["scored_at"]) > then for score in scores)


def _boundary(plan: dict[str, Any]) -> list[str]:
    """Return the faults of the boundary of the plan's design; [] without one."""
    if not plan["stopping"].get("boundary"):
        return []
    probability, alpha = error(plan), share_of(plan)
    print(
        f"the boundary stops wrongly with probability at most {probability:.5f}; alpha of each comparison is {alpha:g}"
    )
    return [] if probability <= alpha else [f"boundary: {probability:.5f} is more than alpha, {alpha:g}"]


def _rows(path: Path) -> Rows:
    with path.open(encoding="utf-8", newline="") as file:
        reader = csv.DictReader(file)
        rows = list(reader)
    if len({*(reader.fieldnames or ())}) < len(reader.fieldnames or ()):
        raise ValueError(f"{path.name}: a column stands twice")
    for number, row in enumerate(rows, start=1):
        if None in row or None in row.values():
            raise ValueError(f"{path.name}: row {number} has another number of cells than the head")
    return [{name: _text(value) for name, value in row.items()} for row in rows]


def _as_revealed(rows: Rows, scores: Rows, at_reveal: dict[str, Any] | None) -> Rows:
    """Return the trials as scored at the reveal: later corrections must not change any figure."""
    if not at_reveal:
        return rows
    then = datetime.fromisoformat(at_reveal["at"])
    newest: dict[str, dict[str, str]] = {}
    for score in scores:  # in the order in which they were given
        if datetime.fromisoformat(score["scored_at"]) <= then:
            newest[score["trial"]] = score
    return [_as_judged(row, newest.get(row["trial"])) for row in rows]


def _as_judged(row: dict[str, str], score: dict[str, str] | None) -> dict[str, str]:
    """Return the trial with the values of `score`, or as ended but unscored if `score` is None.

    The current cause of failure is kept unless `score` has a different success.
    """
    if score is None:
        return {**row, "status": "ended" if row["status"] == "scored" else row["status"]}
    names = ["success", "score", "milestones"]
    if row["success"] != score["success"]:
        names += ["failure", "failure_phase"]
    return {**row, **{name: score[name] for name in names}}


def _agreement(rows: Rows, scores: Rows, ratings: Rows) -> dict[str, Any] | None:
    """Return the agreement of second raters with the scores at the time of their ratings, for trials that count."""
    scores_of = _scores_by_trial(rows, scores)
    pairs = [
        (_stood(scores_of[row["trial"]], row["at"]), row) for row in ratings if row["trial"] in scores_of
    ]
    if not pairs:
        return None
    milestones: dict[str, list[tuple[bool, bool]]] = {}
    for score, rating in pairs:
        reached_again = by_text(json.loads(rating["milestones"]))
        for text, reached in by_text(json.loads(score["milestones"])).items():
            if text in reached_again:
                milestones.setdefault(text, []).append((reached, reached_again[text]))
    return {
        "trials": len({row["trial"] for _, row in pairs}),
        "ratings": len(pairs),
        "blind": sum(row["blind"] == "true" for _, row in pairs),
        "success": agreement([(a["success"] == "true", b["success"] == "true") for a, b in pairs]),
        "milestones": {text: agreement(text_pairs) for text, text_pairs in milestones.items()},
        "score_alpha": score_alpha([(float(a["score"]), float(b["score"])) for a, b in pairs]),
    }


def _scores_by_trial(rows: Rows, scores: Rows) -> dict[str, Rows]:
    """Return the scores of each trial that counts."""
    by_trial: dict[str, Rows] = {row["trial"]: [] for row in rows if row["status"] == "scored"}
    for score in scores:
        by_trial.get(score["trial"], []).append(score)
    return by_trial


def _judges(rows: Rows, scores: Rows, judgements: Rows) -> list[dict[str, Any]] | None:
    """Return the agreement of each version of each automatic judge with the scores at the time of its judgements.

    Only trials that count are included.
    """
    scores_of = _scores_by_trial(rows, scores)
    judges: dict[tuple[str, str], Rows] = {}
    for row in judgements:
        if row["trial"] in scores_of:
            judges.setdefault((row["judge"], row["version"]), []).append(row)
    entries = []
    for (judge, version), judge_rows in sorted(judges.items()):
        triples: dict[str, list[tuple[bool, bool | None, float | None]]] = {}
        for row in judge_rows:
            own = by_text((text, word) for text, *word in json.loads(row["milestones"]))
            stood = _stood(scores_of[row["trial"]], row["at"])
            for text, scored in by_text(json.loads(stood["milestones"])).items():
                if text in own:
                    triples.setdefault(text, []).append((scored, *own[text]))
        reasons = [row["reason"] for row in judge_rows if row["reason"]]
        probable = [(p, scored) for of_one in triples.values() for scored, _, p in of_one if p is not None]
        entries.append(
            {
                "judge": judge,
                "version": version,
                "trials": len(judge_rows),
                "no_verdict": {reason: reasons.count(reason) for reason in reasons},
                "milestones": {text: on_milestone(of_one) for text, of_one in triples.items()},
                "calibration": calibration(probable),
            }
        )
    return entries or None


def _stood(scores: Rows, at: str) -> dict[str, str]:
    """Return the last score given at or before `at`.

    If the clock was set back, so that all scores seem to be later, return the first score.
    """
    then = datetime.fromisoformat(at)
    return next(
        (score for score in reversed(scores) if datetime.fromisoformat(score["scored_at"]) <= then), scores[0]
    )


def _of(preferred: dict[str, str]) -> tuple[str, str]:
    return preferred["first"], preferred["second"]


def _text(cell: str) -> str:
    """Return the cell without the apostrophe that protects texts from becoming formulas in a spreadsheet."""
    return cell[1:] if cell.startswith("'") and cell.lstrip("'").startswith(_FORMULA) else cell


def _trial(row: dict[str, str]) -> Trial:
    return Trial(
        order=int(row["order"]),
        block=row["block"],
        slot=int(row["slot"]),
        checkpoint=row["checkpoint"],
        scene=row["scene"],
        position=int(row["position"]),
        status=row["status"],
        success=row["success"] == "true",
        score=float(row["score"] or 0),
        duration=_float(row["duration_s"]),
        failure=row["failure"],
        milestones=tuple((text, reached) for text, reached in json.loads(row["milestones"] or "[]")),
        smoothness=_float(row["smoothness"]),
        commanded=_float(row["smoothness_commanded"]),
        failure_phase=row["failure_phase"],
        operator=row["operator"],
        station=row["station"],
    )


def _float(cell: str) -> float | None:
    return float(cell) if cell else None


def differences(shown: Any, found: Any, where: str) -> Iterator[tuple[str, str]]:
    """Compare the numbers in numbers.json (`shown`) with the recomputed ones (`found`).

    Yield for each number its place, which begins with `where`, and how it differs as text: "" if it agrees.
    """
    if isinstance(found, Drawn):
        yield where, _drawn(shown, found)
    elif isinstance(shown, dict) and isinstance(found, dict):
        for key in sorted({*shown, *found}):
            place = f"{where}.{key}" if where else key
            if key not in shown or key not in found:
                yield (
                    place,
                    "is not in numbers.json" if key not in shown else "does not follow from the trials",
                )
            else:
                yield from differences(shown[key], found[key], place)
    elif isinstance(shown, list) and isinstance(found, list):
        if len(shown) != len(found):
            yield where, f"{len(shown)} entries are shown, {len(found)} come out"
        for i, (shown_item, found_item) in enumerate(zip(shown, found, strict=False)):
            yield from differences(shown_item, found_item, f"{where}[{i}]")
    elif _number(shown) and _number(found):
        close = math.isclose(shown, found, rel_tol=_CLOSE, abs_tol=1e-9)
        yield where, "" if close else f"{shown} is shown, {found} comes out"
    else:
        yield where, "" if shown == found else f"{shown!r} is shown, {found!r} comes out"


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _drawn(interval: Any, drawn: Drawn) -> str:
    if not (isinstance(interval, list) and len(interval) == 2 and all(map(_number, interval))):
        return f"{interval!r} is shown; an interval comes out"
    low, high = interval
    n, slack = len(drawn.lower), 1e-9
    beyond = (sum(d < low - slack for d in drawn.lower) / n, sum(d > high + slack for d in drawn.upper) / n)
    within = (sum(d <= low + slack for d in drawn.lower) / n, sum(d >= high - slack for d in drawn.upper) / n)
    if max(beyond) > 0.025 + _TAIL or min(within) < 0.025 - _TAIL:
        return f"{interval} is shown; of {n} drawn anew {beyond[0]:.2%} are below and {beyond[1]:.2%} above"
    return ""


if __name__ == "__main__":
    try:
        code = main()
        print(end="", flush=True)  # flush here, so that errors of a closed standard output (`>&-`) are caught
    except _BROKEN as fault:
        print(f"the files in data/ contradict each other: {fault!r}")
        code = 1
    except (
        BrokenPipeError
    ):  # as in `... | head -1`; redirect, so that the interpreter's exit does not fail again
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 141
    except OSError as fault:
        print(f"a file of data/ cannot be read: {fault}")
        code = 1
    sys.exit(code)
