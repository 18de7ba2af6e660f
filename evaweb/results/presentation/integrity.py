"""Record of how an evaluation was made, as a document and in a few sentences."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from typing import Any

from evaweb.plans.models import Plan
from evaweb.results.analysis.conduct import all_attempts, bench_images, plan_conduct
from evaweb.results.analysis.integrity import CATEGORY, VERDICT
from evaweb.results.analysis.wording import p_words
from evaweb.results.presentation.alternatives import headline_alternatives
from evaweb.trials.endings import ENDINGS, ESTOP, INTERRUPTION

_RARE = 0.05  # probability at or below which an anchor counts as drifting


def integrity_document(plan: Plan) -> dict[str, Any]:
    """Return the conduct of the plan, its alternative headlines, and `remarks` that summarise both."""
    images = bench_images(plan)
    runs = all_attempts(plan, images)
    matches = {run.trial: run.match for run in runs if run.match is not None}
    document = {**plan_conduct(plan, runs, images), "headline": headline_alternatives(plan, matches)}
    return {**document, "remarks": list(_remarks(document))}


def delays_banner(found: Mapping[str, Any]) -> str:
    """Return a sentence on differing delays of the compared checkpoints, "" if there are none."""
    delays = found["delays"]
    differing: dict[tuple[str, str], list[str]] = defaultdict(list)
    for row in delays["rows"]:
        for test in row["tests"]:
            if test["corrected"] is not None and test["corrected"] <= delays["alpha"]:
                text = f"{row['what']}, by {_seconds(test['difference'])} s, {p_words(test['corrected'])}"
                differing[test["first"], test["second"]].append(text)
    if not differing:
        return ""
    sentences = ". ".join(
        f"Delays of {first} and {second} differ: {'; '.join(text)}"
        for (first, second), text in differing.items()
    )
    return (
        f"{sentences}. If delays differed by chance alone, a difference as large would be as rare as this (sign flips "
        f"within pairs, Holm over {delays['tested']})"
    )


def too_few_text(found: Mapping[str, Any]) -> str:
    """Return a sentence if the pairs are too few for any test of delays to be significant, else ""."""
    delays = found["delays"]
    pairs = [test["pairs"] for row in delays["rows"] for test in row["tests"] if test["p"] is not None]
    most = max(pairs, default=0)
    if not most or 2.0 ** (1 - most) <= delays["alpha"]:  # the smallest possible p of sign flips
        return ""
    return f"{_of(most, 'pair')} {'is' if most == 1 else 'are'} too few for any of these tests"


def _remarks(document: Mapping[str, Any]) -> Iterator[str]:
    changed = [row["what"] for row in document["headline"] if row["same"] is False]
    if changed:
        yield f"The headline would change: {'; '.join(changed)}"
    people = [row["by_name"] for row in document["looks"] if row["own"]]
    if people:
        yield f"Looked behind the blind before the reveal: {', '.join(people)}"
    for row in document["looks"]:
        if not row["own"]:
            when = "before this version was frozen" if row["before"] else "before the reveal of this one"
            yield f"{row['by_name']} looked behind the blind of {row['name']} v{row['version']} {when}"
    if document["beside"]:
        named = ", ".join(
            f"{row['plan']} v{row['version']} ({_of(row['trials'], 'trial')})" for row in document["beside"]
        )
        yield f"Other plans are of checkpoints of this one, and may have told of them: {named}"
    late = Counter(row["changed"] for row in document["corrections"] if row["late"])
    early = sum(row["changed"] == VERDICT and not row["late"] for row in document["corrections"])
    if early:
        yield f"{_of(early, 'score')} corrected before the reveal"
    if late[VERDICT]:
        yield f"{_of(late[VERDICT], 'score')} came after the reveal"
    if late[CATEGORY]:
        categories = "1 failure category" if late[CATEGORY] == 1 else f"{late[CATEGORY]} failure categories"
        yield f"{categories} corrected after the reveal"
    rows = document["checkpoints"]
    for field, label in (("voided", "voided"), ("repeated", "repeated"), ("interrupted", "interrupted")):
        if any(row[field] for row in rows):
            counts = ", ".join(f"{row['checkpoint']} {row[field]} of {row['attempts']}" for row in rows)
            yield f"Attempts {label}: {counts}"
    for field in (ESTOP, INTERRUPTION):  # not time limits: most failing runs end by them
        if any(row[field] for row in rows):
            counts = ", ".join(f"{row['checkpoint']} {row[field]} of {row['attempts']}" for row in rows)
            yield f"Runs ended by {ENDINGS[field]}: {counts}"
    if any(row["declared"] for row in rows):
        counts = ", ".join(f"{row['checkpoint']} {row['declared']} of {row['counted']}" for row in rows)
        yield f"Failures by the plan, whatever was reached: {counts}"
    edits = Counter(row["what"] for row in document["edits"])
    if edits:
        named = ", ".join(f"{field} ({number})" for field, number in sorted(edits.items()))
        yield f"Edited after the plan was frozen, taken back or not: {named}"
    yield from _departures(document)


def _departures(document: Mapping[str, Any]) -> Iterator[str]:
    deviations = document["deviations"]
    kinds = (
        ("split_stations", "carried out on more than one station"),
        ("split_operators", "carried out by more than one operator"),
        ("order", "not in the order drawn"),
        ("over_a_day", "more than a day apart"),
    )
    for name, label in kinds:
        if deviations[name]:
            yield f"{_of(len(deviations[name]), 'block')} {label}"
    if deviations["out_of_turn"]:
        yield f"{_of(len(deviations['out_of_turn']), 'trial')} handed out of turn"
    made, of = document["benchmark"]
    if made:
        yield (
            f"In benchmark mode, where the bench waits for the policy and a run ends with the first success: {made} of "
            f"{of} trials"
        )
    machines = [row["name"] for row in document["machines"]["rows"]]
    if len({name.rpartition(" ")[2] for name in machines}) > 1:
        counts = ", ".join(f"{row['name']} {sum(row['trials'])}" for row in document["machines"]["rows"])
        yield f"Copies ran on machines of several kinds, where the same trial may differ in its last bits: {counts}"
    for name in ("operators", "stations", "machines"):
        if document[name]["uneven"]:
            yield f"{name.capitalize()} did not share checkpoints evenly: up to {document[name]['uneven']:g} trials off"
    if document["cameras"]["unchecked"]:
        yield f"{_of(len(document['cameras']['unchecked']), 'trial')} without cameras confirmed in the 12 hours before"

    yield from _of_the_bench(document["bench"])
    for row in document["anchors"]:
        for name, since in (("against_earlier", "earlier plans"), ("within", "its first half")):
            if row[name] is not None and row[name] <= _RARE:
                yield (
                    f"Anchor {row['checkpoint']} did not succeed as often as in {since} ({p_words(row[name])}): bench "
                    "or scoring may have drifted"
                )


def _of_the_bench(bench: Mapping[str, Any]) -> Iterator[str]:
    if bench["low"]:
        by = Counter(row["checkpoint"] for row in bench["low"])
        counts = ", ".join(f"{name} {count}" for name, count in sorted(by.items()))
        yield f"Run although the bench matched less than {bench['gate']:g}, for a reason: {counts}"
    if bench["unmatched"]:
        yield f"{_of(len(bench['unmatched']), 'trial')} without a known match of the bench"
    for row in bench["references"]:
        yield (
            f"{row['camera']} of {row['station']} had {row['used']} references at {row['scene']}, position "
            f"{row['position']}, while trials were made"
        )


def _of(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _seconds(value: float) -> str:
    return f"{value:+.3g}".replace("-", "−")
