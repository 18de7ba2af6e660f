"""Completeness of the record: nothing is missing that was tried or recorded, and nothing was changed after
the reveal.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from itertools import pairwise
from typing import Any

from .sealed import digest

ATTEMPT = (
    *("trial", "uuid", "order", "code", "slot", "block", "checkpoint", "scene", "position", "repetition"),
    *("attempt", "why_again", "station", "operator", "started_at", "ended_at"),
)
MEASURED = ("trial", "duration_s", "ended_by")
LOOKED_AT = ("smoothness", "smoothness_commanded")
SCORE = (
    *("trial", "rater", "source", "success", "score", "milestones", "failure", "failure_phase", "note"),
    *("reason", "scored_at"),
)
ENDED = ("estop", "interruption", "timeout")
STAYS = ("looks", "voids", "cameras")  # unchanged after a reveal
Rows = Sequence[Mapping[str, str]]


def gaps(rows: Rows, scores: Rows, record: Mapping[str, Any]) -> list[str]:
    """Return gaps: missing trials, attempts, scores and corrections."""
    sentences = _missing(
        "trials.csv lacks the trial handed out as number", [int(row["order"]) for row in rows]
    )
    attempts: dict[str, list[int]] = defaultdict(list)
    for row in rows:
        attempts[row["slot"]].append(int(row["attempt"]))
    for slot, numbers in attempts.items():
        sentences += _missing(f"slot {slot} of the schedule lacks attempt", numbers)
    by_trial: dict[str, list[Mapping[str, str]]] = defaultdict(list)
    for score in scores:
        by_trial[score["trial"]].append(score)
    for trial, own_scores in by_trial.items():
        sentences += [
            f"trial {trial} has a correction and no score before it"
            for score in own_scores[:1]
            if score["reason"]
        ]
        sentences += [
            f"trial {trial} has a correction without a reason"
            for score in own_scores[1:]
            if not score["reason"]
        ]
    told_of = {str(row["trial_id"]) for row in record.get("corrections", ())}
    sentences += [
        f"integrity.json does not have the correction of trial {trial}"
        for trial, own_scores in by_trial.items()
        if len(own_scores) > 1 and trial not in told_of
    ]
    return sentences + list(_counts(rows, by_trial, record)) + list(_copies(rows, by_trial))


def _counts(rows: Rows, by_trial: Mapping[str, Rows], record: Mapping[str, Any]) -> Iterator[str]:
    """Yield the counts by checkpoint in integrity.json that differ from the tables."""
    by = {row["checkpoint"]: row for row in record.get("checkpoints", ())}
    for name in sorted({row["checkpoint"] for row in rows}):
        own = [row for row in rows if row["checkpoint"] == name]
        turned = [
            (earlier["success"], later["success"])
            for row in own
            for earlier, later in pairwise(by_trial.get(row["trial"], ()))
        ]
        statuses = Counter(row["status"] for row in own)
        counts = {
            "attempts": len(own),
            "counted": statuses["scored"],
            "voided": statuses["voided"],
            "asked": statuses["void_asked"],
            "interrupted": statuses["interrupted"],
            "abandoned": statuses["abandoned"],
            "repeated": sum(int(row["attempt"]) > 1 for row in own),
            "to_success": turned.count(("false", "true")),
            "to_failure": turned.count(("true", "false")),
        }
        stated = by.get(name, {})
        counts |= {key: sum(row.get("ended_by") == key for row in own) for key in ENDED if key in stated}
        for key, number in counts.items():
            if stated.get(key) != number:
                label = key.replace("_", " ")
                yield f"{number} trials of {name} are {label}, integrity.json says {stated.get(key)}"
    voided = {row["trial"] for row in rows if row["status"] in ("voided", "void_asked")}
    recorded = {str(row["trial_id"]) for row in record.get("voids", ())}
    yield from (
        f"integrity.json does not have the void of trial {trial}" for trial in sorted(voided - recorded)
    )
    broken = {row["trial"] for row in rows if row["status"] in ("interrupted", "abandoned")}
    recorded = {str(row["trial_id"]) for row in record.get("broken_off", ())}
    yield from (
        f"integrity.json does not have the end of trial {trial}" for trial in sorted(broken - recorded)
    )


def _copies(rows: Rows, by_trial: Mapping[str, Rows]) -> Iterator[str]:
    """Yield values in trials.csv that differ from the score that counts in scores.csv."""
    for row in rows:
        if row["status"] == "scored" and (scores := by_trial.get(row["trial"])):
            for name in SCORE:
                if name in row and name not in ("trial", "reason") and row[name] != scores[-1][name]:
                    cell, scored = row[name], scores[-1][name]
                    yield f"trials.csv says of trial {row['trial']} {name} = {cell!r}, its score {scored!r}"


def changes(
    rows: Rows,
    scores: Rows,
    judged: Mapping[str, Rows],
    seal: Mapping[str, Any],
    record: Mapping[str, Any],
) -> list[str]:
    """Return one sentence for each part of the data that was changed after the reveal; [] before a reveal.

    Changes are found by comparing digests of the data with those that the reveal recorded. `judged` are the tables of
    raters and judges.
    """
    reveal = seal["at_reveal"]
    if not reveal:
        return []
    sentences = [] if seal["key"] else ["what counts was kept, and seal.json has no key"]
    if "record" not in reveal:  # plans up to format 5
        return sentences
    then = datetime.fromisoformat(reveal["at"])
    attempts = [
        [*(row[name] for name in ATTEMPT), row["reason"] if row["status"] == "voided" else ""] for row in rows
    ]
    stated = [
        [row[name] for name in SCORE] for row in scores if datetime.fromisoformat(row["scored_at"]) <= then
    ]
    if digest({"attempts": attempts, "scores": stated}) != reveal["record"]:
        sentences.append(
            "attempts, scores, reasons or times are not those of which the reveal kept the digest"
        )
    if "measured" in reveal:  # not recorded by earlier reveals
        names = reveal["measured"].get("names", MEASURED)
        later = {str(trial) for trial in reveal["measured"]["later"]}
        values = [
            [row[name] for name in (*names, *(() if row["trial"] in later else LOOKED_AT))] for row in rows
        ]
        if digest(values) != reveal["measured"]["digest"]:
            sentences.append(
                "durations, smoothness or what ended a run are not those of which the reveal kept the digest"
            )
    if "judged" in reveal:  # from format 7 on
        judged_values = {
            name: [[*row.values()] for row in table if datetime.fromisoformat(row["at"]) <= then]
            for name, table in judged.items()
        }
        if digest(judged_values) != reveal["judged"]:
            sentences.append(
                "ratings, preferences or judgements are not those of which the reveal kept the digest"
            )
        if digest({name: record.get(name) for name in STAYS}) != reveal["conduct"]:
            sentences.append(
                "integrity.json is not that of which the reveal kept the digest: " + ", ".join(STAYS)
            )
    headline = ". ".join(reveal.get("headline", ()))
    if any(row.get("headline", headline) != headline for row in rows):
        sentences.append("trials.csv has another headline than the reveal")
    return sentences


def _missing(label: str, numbers: Sequence[int]) -> list[str]:
    expected = set(range(1, max(numbers, default=0) + 1))
    repeated = {number for number in numbers if list(numbers).count(number) > 1}
    return [f"{label} {number}" for number in sorted(expected - set(numbers))] + [
        f"{label} {number} alone: it is there twice" for number in sorted(repeated)
    ]
