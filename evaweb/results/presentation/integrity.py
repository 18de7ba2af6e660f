"""The record of how an evaluation was made, in one document and in a few sentences."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from evaweb.plans.models import Plan
from evaweb.results.analysis.conduct import conduct_of, runs_of
from evaweb.results.presentation.wording import p_words
from evaweb.results.presentation.would_be import would_be


def integrity_document(plan: Plan) -> dict[str, Any]:
    """What the record says, what the headline would be under each doubt, and `remarks` that sum both up."""
    runs = runs_of(plan)
    matches = {run.trial: run.match for run in runs if run.match is not None}
    found = {**conduct_of(plan, runs), "headline": would_be(plan, matches)}
    return {**found, "remarks": list(_remarks(found))}


def delays_banner(found: Mapping[str, Any]) -> str:
    """A sentence where delays of the compared checkpoints differ, "" where none does."""
    delays = found["delays"]
    rows = [row for row in delays["rows"] if row["what"] in delays["differing"]]
    if not rows:
        return ""
    first, second = delays["comparison"]
    said = "; ".join(
        f"{row['what']}, by {_seconds(row['difference'])} s, {p_words(row['corrected'])}" for row in rows
    )
    return (
        f"Delays of {first} and {second} differ: {said}. Were delays the same but for chance, a "
        f"difference as wide would come about so rarely (sign flips within pairs, Holm over {delays['tested']})"
    )


def _remarks(found: Mapping[str, Any]) -> Iterator[str]:
    other = [row["what"] for row in found["headline"] if row["same"] is False]
    if other:
        yield f"The headline would be another one {'; '.join(other)}"
    looks = [row["by_name"] for row in found["looks"]]
    if looks:
        yield f"Looked behind the blind before the reveal: {', '.join(looks)}"
    late = sum(row["late"] for row in found["corrections"])
    if late:
        yield f"{_of(late, 'score')} came after the reveal"
    rows = found["checkpoints"]
    for what, words in (("voided", "voided"), ("repeated", "repeated"), ("interrupted", "interrupted")):
        if any(row[what] for row in rows):
            counts = ", ".join(f"{row['checkpoint']} {row[what]} of {row['attempts']}" for row in rows)
            yield f"Attempts {words}: {counts}"
    yield from _departures(found)


def _departures(found: Mapping[str, Any]) -> Iterator[str]:
    deviations = found["deviations"]
    kinds = (
        ("split_stations", "carried out on more than one station"),
        ("split_operators", "carried out by more than one operator"),
        ("order", "not in the order that was drawn"),
        ("over_a_day", "more than a day apart"),
    )
    for name, words in kinds:
        if deviations[name]:
            yield f"{_of(len(deviations[name]), 'block')} {words}"
    if deviations["out_of_turn"]:
        yield f"{_of(len(deviations['out_of_turn']), 'trial')} handed out of turn"
    for name in ("operators", "stations"):
        if found[name]["uneven"]:
            yield f"{name.capitalize()} did not have all checkpoints equally often: up to {found[name]['uneven']} apart"
    if found["cameras"]["unchecked"]:
        yield f"{_of(len(found['cameras']['unchecked']), 'trial')} without cameras confirmed in the 12 hours before"


def _of(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def _seconds(value: float) -> str:
    return f"{value:+.3g}".replace("-", "−")
