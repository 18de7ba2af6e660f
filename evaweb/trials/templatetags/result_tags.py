"""Template filters and tags for numbers on the result pages."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from django import template

from evaweb.statistics.means import Average
from evaweb.statistics.proportions import Proportion
from evaweb.trials import rate_bars
from evaweb.trials.average_text import average_text
from evaweb.trials.lifecycle import advice
from evaweb.trials.models import Evaluation, TrialStatus

register = template.Library()


@register.filter
def percent(share: float | str | None) -> str:
    """Return a fraction as whole percent; a dash if it is unknown (templates pass "" then)."""
    return rate_bars.format_percent(share) if isinstance(share, float | int) else "–"


@register.filter
def seconds(value: float | str | None) -> str:
    """Return a duration in seconds with one decimal and unit; a dash if it is unknown."""
    return f"{value:.1f} s" if isinstance(value, float | int) else "–"


_LABELS = {"failure_phase": "Phase", "failure": "Cause"}


@register.simple_tag(takes_context=True)
def filter_chips(context: Any, names: str) -> list[dict[str, str]]:
    """Return the active filters among `names`: each as text (`words`), with the query string without it (`without`)."""
    query = context["request"].GET
    chips = []
    for name in names.split():
        if value := query.get(name, "").strip():
            left = query.copy()
            for key in [key for key in left if key in (name, "page") or not left[key]]:
                del left[key]
            is_key = name == "evaluation" and value.isdecimal() and len(value) < 16
            text = Evaluation.objects.filter(pk=value).first() if is_key else value
            chips.append(
                {"words": f"{_LABELS.get(name, name.capitalize())}: {text}", "without": left.urlencode()}
            )
    return chips


@register.filter
def interval(found: Proportion) -> str:
    """Return the ends of the interval in whole percent."""
    return rate_bars.format_interval(found)


@register.filter
def mean_with_interval(found: Average | None, of: int) -> str:
    """Return a mean with its interval and count; a dash if there is none."""
    return average_text(found, of) or "–"


@register.filter
def control_figures(control: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the timing figures of the control loop that the episode has: label, and value with unit."""
    figures = ((label, unit, control.get(key)) for key, (label, unit) in _CONTROL.items())
    return [(label, f"{_short(value)} {unit}".strip()) for label, unit, value in figures if value is not None]


_CONTROL = {
    "rate": ("Rate", "Hz"),
    "ticks": ("Ticks", ""),
    "missed": ("Ticks missed", ""),
    "lateness_p50_ms": ("Lateness, median", "ms"),
    "lateness_p99_ms": ("Lateness, 99th percentile", "ms"),
    "lateness_max_ms": ("Lateness, worst", "ms"),
    "scheduling": ("Scheduling", ""),
    "records_lost": ("Records lost", ""),
}


def _short(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


@register.filter
def humanize_name(name: str) -> str:
    """Return a code name with spaces: over_plate becomes "over plate"."""
    return name.replace("_", " ")


@register.filter
def split_words(text: str) -> list[str]:
    """Return the words of a text."""
    return text.split()


@register.filter
def tone(status: str) -> str:
    """Return the style sheets' colour name for a trial status."""
    return TrialStatus(status).tone


@register.filter
def next_step(status: str) -> str:
    """Return advice to the user on a trial in this status."""
    return advice(status)
