"""Scores compared with the plan: milestones of its scenes, required milestones, points, and rules for abnormal ends."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

_JUDGED_AS_FROZEN = 5  # plan format from which trials are judged by the frozen scenes


def scene_faults(
    plan: Mapping[str, Any], rows: Sequence[Mapping[str, str]], *judged: Sequence[Mapping[str, str]]
) -> list[str]:
    """Return scores and second ratings that contradict the scene of their trial in the plan."""
    if plan.get("format", 1) < _JUDGED_AS_FROZEN:
        return []
    scenes = {scene["name"]: scene["milestones"] for scene in plan["scenes"]}
    played = {row["trial"]: row["scene"] for row in rows}
    counts = plan.get("counts_as", {})
    fails = {row["trial"] for row in rows if counts.get(f"on_{row.get('ended_by', '')}") == "failure"}
    return [
        f"trial {judged_row['trial']}, judged by {judged_row['rater']}: {fault}"
        for judged_rows in judged
        for judged_row in judged_rows
        if judged_row["trial"] in played
        for fault in _faults(
            judged_row, scenes.get(played[judged_row["trial"]], []), judged_row["trial"] in fails
        )
    ]


def ending_faults(plan: Mapping[str, Any], rows: Sequence[Mapping[str, str]]) -> list[str]:
    """Return runs with an abnormal end that do not count as the plan requires."""
    counts = plan.get("counts_as", {})
    last = {row["slot"]: int(row["attempt"]) for row in sorted(rows, key=lambda row: int(row["attempt"]))}
    sentences = []
    for row in rows:
        by = row.get("ended_by", "")
        rule = counts.get(f"on_{by}", "judged")
        if rule == "repeated" and row["status"] == "scored":
            sentences.append(f"trial {row['trial']} counts, its end ({by}) is repeated by the plan")
        if rule == "failure" and row["status"] == "scored" and row["success"] == "true":
            sentences.append(f"trial {row['trial']} is a success, its end ({by}) is a failure by the plan")
        nothing = row.get("frames", "1") in ("", "0")  # without frames it could not be scored
        was_repeated = row["status"] == "interrupted" and int(row["attempt"]) < last[row["slot"]]
        if rule == "failure" and was_repeated and not nothing:
            sentences.append(f"trial {row['trial']} was repeated, its end ({by}) is a failure by the plan")
    return sentences


def _faults(
    judged_row: Mapping[str, str], milestones: Sequence[Mapping[str, Any]], fails: bool
) -> Iterator[str]:
    reached = json.loads(judged_row["milestones"] or "[]")
    if [text for text, _ in reached] != [row["text"] for row in milestones]:
        yield "its milestones are not those of the plan"
        return
    ticks = [bool(is_reached) for _, is_reached in reached]
    success = judged_row["success"] == "true"
    required = [is_reached for is_reached, row in zip(ticks, milestones, strict=True) if row["required"]]
    if required and not fails and success != all(required):
        yield f"success is {success}, its required milestones say {all(required)}"
    points = [row["points"] for row in milestones]
    total = sum(points)
    share = (
        sum(p for p, is_reached in zip(points, ticks, strict=True) if is_reached) / total
        if total
        else float(success)
    )
    if not math.isclose(float(judged_row["score"]), share, abs_tol=1e-9):
        yield f"its score is {judged_row['score']}, the plan's points give {share:g}"
