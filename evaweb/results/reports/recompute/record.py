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
    found = _missing("trials.csv lacks the trial handed out as number", [int(row["order"]) for row in rows])
    attempts: dict[str, list[int]] = defaultdict(list)
    for row in rows:
        attempts[row["slot"]].append(int(row["attempt"]))
    for slot, numbers in attempts.items():
        found += _missing(f"slot {slot} of the schedule lacks attempt", numbers)
    given: dict[str, list[Mapping[str, str]]] = defaultdict(list)
    for score in scores:
        given[score["trial"]].append(score)
    for trial, told in given.items():
        found += [
            f"trial {trial} has a correction and no score before it" for score in told[:1] if score["reason"]
        ]
        found += [
            f"trial {trial} has a correction without a reason" for score in told[1:] if not score["reason"]
        ]
    told_of = {str(row["trial_id"]) for row in record.get("corrections", ())}
    found += [
        f"integrity.json does not have the correction of trial {trial}"
        for trial, told in given.items()
        if len(told) > 1 and trial not in told_of
    ]
    return found + list(_counts(rows, given, record)) + list(_copies(rows, given))


def _counts(rows: Rows, given: Mapping[str, Rows], record: Mapping[str, Any]) -> Iterator[str]:
    """Yield the counts by checkpoint in integrity.json that differ from the tables."""
    by = {row["checkpoint"]: row for row in record.get("checkpoints", ())}
    for name in sorted({row["checkpoint"] for row in rows}):
        own = [row for row in rows if row["checkpoint"] == name]
        turned = [
            (one["success"], other["success"])
            for row in own
            for one, other in pairwise(given.get(row["trial"], ()))
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
        said = by.get(name, {})
        counts |= {what: sum(row.get("ended_by") == what for row in own) for what in ENDED if what in said}
        for what, number in counts.items():
            if said.get(what) != number:
                words = what.replace("_", " ")
                yield f"{number} trials of {name} are {words}, integrity.json says {said.get(what)}"
    voided = {row["trial"] for row in rows if row["status"] in ("voided", "void_asked")}
    told = {str(row["trial_id"]) for row in record.get("voids", ())}
    yield from (f"integrity.json does not have the void of trial {trial}" for trial in sorted(voided - told))
    broken = {row["trial"] for row in rows if row["status"] in ("interrupted", "abandoned")}
    told = {str(row["trial_id"]) for row in record.get("broken_off", ())}
    yield from (f"integrity.json does not have the end of trial {trial}" for trial in sorted(broken - told))


def _copies(rows: Rows, given: Mapping[str, Rows]) -> Iterator[str]:
    """Yield values in trials.csv that differ from the score that counts in scores.csv."""
    for row in rows:
        if row["status"] == "scored" and (scores := given.get(row["trial"])):
            for name in SCORE:
                if name in row and name not in ("trial", "reason") and row[name] != scores[-1][name]:
                    said, wanted = row[name], scores[-1][name]
                    yield f"trials.csv says of trial {row['trial']} {name} = {said!r}, its score {wanted!r}"


def changes(
    rows: Rows,
    scores: Rows,
    judged: Mapping[str, Rows],
    seal: Mapping[str, Any],
    record: Mapping[str, Any],
) -> list[str]:
    """Return what was changed after the reveal, by the digests in its record; [] before a reveal.

    `judged` are the tables of raters and judges.
    """
    kept = seal["at_reveal"]
    if not kept:
        return []
    found = [] if seal["key"] else ["what counts was kept, and seal.json has no key"]
    if "record" not in kept:  # plans up to format 5
        return found
    then = datetime.fromisoformat(kept["at"])
    attempts = [
        [*(row[name] for name in ATTEMPT), row["reason"] if row["status"] == "voided" else ""] for row in rows
    ]
    said = [
        [row[name] for name in SCORE] for row in scores if datetime.fromisoformat(row["scored_at"]) <= then
    ]
    if digest({"attempts": attempts, "scores": said}) != kept["record"]:
        found.append("attempts, scores, reasons or times are not those of which the reveal kept the digest")
    if "measured" in kept:  # not recorded by earlier reveals
        names = kept["measured"].get("names", MEASURED)
        later = {str(trial) for trial in kept["measured"]["later"]}
        values = [
            [row[name] for name in (*names, *(() if row["trial"] in later else LOOKED_AT))] for row in rows
        ]
        if digest(values) != kept["measured"]["digest"]:
            found.append(
                "durations, smoothness or what ended a run are not those of which the reveal kept the digest"
            )
    if "judged" in kept:  # from format 7 on
        told = {
            name: [[*row.values()] for row in table if datetime.fromisoformat(row["at"]) <= then]
            for name, table in judged.items()
        }
        if digest(told) != kept["judged"]:
            found.append(
                "ratings, preferences or judgements are not those of which the reveal kept the digest"
            )
        if digest({name: record.get(name) for name in STAYS}) != kept["conduct"]:
            found.append(
                "integrity.json is not that of which the reveal kept the digest: " + ", ".join(STAYS)
            )
    said = ". ".join(kept.get("headline", ()))
    if any(row.get("headline", said) != said for row in rows):
        found.append("trials.csv has another headline than the reveal")
    return found


def _missing(what: str, numbers: Sequence[int]) -> list[str]:
    wanted = set(range(1, max(numbers, default=0) + 1))
    twice = {number for number in numbers if list(numbers).count(number) > 1}
    return [f"{what} {number}" for number in sorted(wanted - set(numbers))] + [
        f"{what} {number} alone: it is there twice" for number in sorted(twice)
    ]
