"""Whether the record is whole: nothing that was tried or said is missing, and nothing was changed since the reveal."""

from __future__ import annotations

import html
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
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
Rows = Sequence[Mapping[str, str]]
HIDDEN = re.compile(
    r"<!--.*?-->|<(script|style|template)\b.*?</\1>", re.DOTALL
)  # of a page, from who reads it


def gaps(rows: Rows, scores: Rows, record: Mapping[str, Any]) -> list[str]:
    """What was handed out or said and is not there any more."""
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
    by = {row["checkpoint"]: row["voided"] for row in record.get("checkpoints", ())}
    for name in sorted({row["checkpoint"] for row in rows}):
        voided = sum(row["status"] == "voided" for row in rows if row["checkpoint"] == name)
        if by.get(name) != voided:
            found.append(f"{voided} trials of {name} are voided, integrity.json says {by.get(name)}")
    return found


def changes(
    rows: Rows, scores: Rows, seal: Mapping[str, Any], record: Mapping[str, Any], page: str
) -> list[str]:
    """What is not as the reveal kept it; `page` is the report's own. Nothing before a reveal."""
    kept = seal["at_reveal"]
    if not kept:
        return []
    found = [] if seal["key"] else ["what counts was kept, and seal.json has no key"]
    if "record" not in kept:  # plans of format 5 and before
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
    if "measured" in kept:  # those of before have none
        later = {str(trial) for trial in kept["measured"]["later"]}
        values = [
            [row[name] for name in (*MEASURED, *(() if row["trial"] in later else LOOKED_AT))] for row in rows
        ]
        if digest(values) != kept["measured"]["digest"]:
            found.append(
                "durations, smoothness or what ended a run are not those of which the reveal kept the digest"
            )
    text = html.unescape(HIDDEN.sub("", page))
    found += [f"index.html does not say: {one}" for one in _unsaid(kept, text)]
    return found


def _unsaid(kept: Mapping[str, Any], page: str) -> Iterator[str]:
    for sentence in (*kept.get("headline", ()), *kept.get("caveats", ()), kept.get("setting", "")):
        if sentence not in page:
            yield sentence


def _missing(what: str, numbers: Sequence[int]) -> list[str]:
    wanted = set(range(1, max(numbers, default=0) + 1))
    twice = {number for number in numbers if list(numbers).count(number) > 1}
    return [f"{what} {number}" for number in sorted(wanted - set(numbers))] + [
        f"{what} {number} alone: it is there twice" for number in sorted(twice)
    ]
