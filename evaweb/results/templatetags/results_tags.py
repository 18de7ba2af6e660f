"""Template filters and tags of the result pages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from django import template
from django.urls import reverse
from django.utils.html import format_html, format_html_join
from django.utils.safestring import SafeString

from evaweb.plans.design import visible_close_reason
from evaweb.plans.models import Plan, PlanState, StoppingRule
from evaweb.results.analysis import wording
from evaweb.results.analysis.filters import TrialFilter
from evaweb.results.analysis.outcomes import Outcome
from evaweb.statistics.difference import Difference
from evaweb.statistics.proportions import Proportion

register = template.Library()
_MOST_NAMED = 12
_TONES = {
    PlanState.DRAFT: "active",
    PlanState.FROZEN: "ok",
    PlanState.CLOSED: "warn",
    PlanState.REVEALED: "neutral",
}


@register.filter
def plan_tone(plan: Plan) -> str:
    """Return the colour of a plan's state, by its name in the style sheets."""
    return _TONES[PlanState(plan.state)]


@register.filter
def design_text(rule: str) -> str:
    """Return a design in one or two words."""
    return str(StoppingRule(rule).label).partition(":")[0]


@register.filter
def rate_text(found: Proportion) -> str:
    """Return x/n, percent and interval."""
    return wording.rate_words(found)


@register.filter
def difference_text(found: Difference) -> str:
    """Return percentage points with their interval."""
    return wording.format_points(found)


@register.filter
def probability(p: float) -> str:
    """Return a probability as papers print it, for example "0.03" or "< 0.001"."""
    return wording.probability(p)


@register.filter
def p_value_text(p: float) -> str:
    """Return a p-value as text, for example "p = 0.03" or "p < 0.001"."""
    return wording.p_words(p)


@register.filter
def outcome_text(run: Outcome) -> str:
    """Return success or failure with its cause, and the share of points if it is neither 0 nor 1."""
    text = "success" if run.success else ": ".join(filter(None, ("failure", run.why)))
    return f"{text}, {100 * run.score:.0f} % of points" if 0 < run.score < 1 else text


@register.filter
def evalue_threshold(alpha: float) -> str:
    """Return the e-value at which one of two directions is significant."""
    return f"{2 / alpha:g}"


@register.filter
def filter_items(only: TrialFilter) -> list[tuple[str, str]]:
    """Return the selected filters as (name, value)."""
    return [(name, value) for name, value in asdict(only).items() if value]


@register.filter
def rows_of_trial(rows: Mapping[int, list[Any]], trial: int) -> list[Any]:
    """Return the rows of one trial."""
    return rows.get(trial, [])


@register.simple_tag
def closed_because(plan: Plan, sealed: bool) -> str:
    """Return the reason for which the plan was closed.

    If the plan is `sealed` for the reader, return only what that reader may know.
    """
    return visible_close_reason(plan, sealed)


@register.simple_tag
def export_links(plan: Plan, only: TrialFilter) -> SafeString:
    """Return links to the plan's trials as tables, and to its report."""
    address = reverse("api:plan-outcomes", args=[plan.name, plan.version])
    query = f"&{only.query}" if only.query else ""
    links = [(f"{address}?format={kind}{query}", label) for kind, label in _FORMATS]
    links.append((reverse("result-report", args=[plan.name, plan.version]), "Report, offline"))
    links.append((reverse("result-crate", args=[plan.name, plan.version]), "RO-Crate"))
    return format_html("{}", format_html_join(" ", '<a href="{}">{}</a>', links))


_FORMATS = (("csv", "Trials as CSV"), ("parquet", "as Parquet"), ("json", "as JSON"))


@register.filter
def count_and_list(found: list[Any], what: str) -> str:
    """Return the number of items and the names of the first ones; `what` is the noun that precedes the names."""
    if not found:
        return "none"
    names = ", ".join(str(item) for item in found[:_MOST_NAMED])
    more = f" and {len(found) - _MOST_NAMED} more" if len(found) > _MOST_NAMED else ""
    return f"{len(found)} ({what}{'s' * (len(found) > 1)} {names}{more})"


@register.filter
def percent_points(share: float) -> str:
    """Return a difference of shares in whole percentage points."""
    return f"{100 * share:.0f}"


@register.filter
def percent(share: float, digits: int = 3) -> str:
    """Return a share in percent, without trailing zeros."""
    return f"{100 * share:.{digits}f}".rstrip("0").rstrip(".") if digits else f"{100 * share:.0f}"


@register.filter
def shared(total: float, among: int) -> float:
    """Return one of `among` equal shares of `total`."""
    return total / among


@register.filter
def minus(count: int, shown: list[Any]) -> int:
    """Return how many of `count` items are not among those `shown`."""
    return count - len(shown)


@register.filter
def field_text(name: str) -> str:
    """Return the name of a draft's field as the page shows it."""
    return _FIELD_WORDS.get(name, name.replace("_", " ").capitalize())


_FIELD_WORDS = {
    "challenger": "Compared with the control",
    "comparing": "Compared",
    "stopping": "Design",
    "repetitions": "Trials at each position",
    "look_after": "Looks",
    "drop_arms": "Drop checkpoints",
    "allocation": "Order in a block",
    "outcome": "Primary outcome",
    "second_rater_share": "Second rater",
    "match_gate": "Minimum match",
    "title": "Name",
}


@register.filter
def agreement_text(found: dict[str, Any]) -> str:
    """Return how often two raters agreed, with n and interval."""
    low, high = found["wilson"]
    share = 100 * found["same"] / found["n"]
    return f"{found['same']}/{found['n']}, {share:.0f} % [{100 * low:.0f}, {100 * high:.0f}]"


@register.filter
def contrast_text(found: dict[str, Any]) -> str:
    """Return the probability that the first is preferred to the second."""
    low, high = found["interval"]
    return (
        f"{found['first']} is preferred to {found['second']} with probability {found['win_probability']:.2f} "
        f"[{low:.2f}, {high:.2f}]"
    )
