"""The headline of an evaluation: what the design of its plan says, and nothing else."""

from __future__ import annotations

from dataclasses import dataclass

from evaweb.plans.design import frozen, tried
from evaweb.plans.models import Plan, PlanState
from evaweb.results.presentation.wording import p_words, points
from evaweb.statistics.designs import SUCCESS, Conclusion, Design, conclude
from evaweb.statistics.difference import newcombe


@dataclass(frozen=True, slots=True)
class Headline:
    """One sentence, how it was decided, and what else it could be.

    `corrected`: with the scores that were corrected after the reveal. `at_first`: as trials were first scored, had none
    been voided.
    `worst`: of a difference, had each attempt that was thrown away unscored been against it. Each is empty where it is
    made of the same pairs.
    """

    sentence: str
    method: str
    corrected: str = ""
    at_first: str = ""
    worst: str = ""
    versions: tuple[str, ...] = ()


def headline(plan: Plan) -> Headline | None:
    """That of a frozen plan; None where it has no comparison."""
    found = frozen(plan.document) if plan.document else None
    if found is None:
        return None
    pairs = tried(plan)
    now, whole = pairs.counted, pairs.at_first
    at_reveal = [(one, other) for one, other in plan.at_reveal["pairs"]] if plan.at_reveal else now
    sentence = sentence_of(plan, found, at_reveal)
    later = sentence_of(plan, found, now) if now != at_reveal else ""
    at_first = sentence_of(plan, found, whole) if whole != at_reveal else ""
    winner = conclude(found, at_reveal).winner
    least = pairs.against(winner) if winner else now
    worst = sentence_of(plan, found, least) if least != now else ""
    return Headline(
        sentence, f"{rule_words(plan)}, alpha {found.alpha:g}", later, at_first, worst, _versions(plan)
    )


def rule_words(plan: Plan) -> str:
    """The rule of its design in one or two words."""
    return str(plan.get_stopping_display()).partition(":")[0]


def sentence_of(plan: Plan, found: Design, pairs: list[tuple[float, float]]) -> str:
    """What the design says of these pairs, in one sentence."""
    conclusion = conclude(found, pairs)
    first, second = (plan.document or {})["comparison"]
    if not conclusion.ended:
        made = f"{conclusion.pairs} of {found.pairs} pairs"
        if plan.state == PlanState.FROZEN:
            return f"{first} and {second} are not compared yet: {made} are made, and the design goes on"
        return f"{first} and {second} were not compared: closed after {made}, before the design ended"
    counted = pairs[: conclusion.at]
    if conclusion.winner == "second":  # the better one is named first
        counted = [(other, one) for one, other in counted]
    counts = _counts(found, conclusion, counted)
    if found.margin is not None:
        claim = f"{first} is {'' if conclusion.winner else 'not shown to be '}not worse than {second}"
        return f"{claim} by {100 * found.margin:g} points or more: {counts}"
    if conclusion.winner is None:
        return f"No significant difference between {first} and {second}: {counts}"
    better, worse = (first, second) if conclusion.winner == "first" else (second, first)
    what = "succeeded more often" if found.outcome == SUCCESS else "reached higher scores"
    return f"{better} {what} than {worse}: {counts}"


def _versions(plan: Plan) -> tuple[str, ...]:
    """What each version before this one came to, the newest first: each had all of its alpha."""
    told, version = [], plan.amends
    while version is not None:
        found = frozen(version.document) if version.document else None
        if found is not None:
            pairs = version.at_reveal["pairs"] if version.at_reveal else tried(version).counted
            sentence = sentence_of(version, found, [(one, other) for one, other in pairs])
            told.append(f"Version {version.version}: {sentence}. Amended because: {_amended(version)}")
        version = version.amends
    return tuple(told)


def _amended(version: Plan) -> str:
    return version.amendment.amended_because


def _counts(found: Design, conclusion: Conclusion, pairs: list[tuple[float, float]]) -> str:
    n = len(pairs)
    one, other = sum(a for a, _ in pairs), sum(b for _, b in pairs)
    if found.outcome != SUCCESS:
        chance = "" if conclusion.p is None else f", {p_words(conclusion.p)},"
        return f"mean scores {one / n:.2f} and {other / n:.2f}{chance} after {n} pairs"
    words = f"{one:.0f}/{n} against {other:.0f}/{n}"
    if (
        conclusion.p is not None
    ):  # of a fixed number of pairs: an interval of the difference means what it says
        words += f", difference {points(newcombe(int(one), n, int(other), n))}, {p_words(conclusion.p)}"
    return f"{words}, after {n} of {found.pairs} pairs"
