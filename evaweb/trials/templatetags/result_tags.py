"""How numbers are written on the result pages."""

from __future__ import annotations

from typing import Any

from django import template

from evaweb.trials import figures
from evaweb.trials.lifecycle import advice
from evaweb.trials.models import TrialStatus
from evaweb.trials.statistics import Proportion

register = template.Library()


@register.filter
def percent(share: float | str | None) -> str:
    """A share as whole percent; a dash where it is not known (templates say "" for that)."""
    return figures.percent(share) if isinstance(share, float | int) else "–"


@register.filter
def seconds(value: float | str | None) -> str:
    """Seconds with one decimal and the unit; a dash where they are not known."""
    return f"{value:.1f} s" if isinstance(value, float | int) else "–"


@register.filter
def interval(found: Proportion) -> str:
    """The ends of the interval in whole percent."""
    return figures.interval(found)


@register.filter
def figure(value: Any) -> str:
    """A figure of the control loop: numbers short, all else as it is."""
    if isinstance(value, bool) or not isinstance(value, float):
        return str(value)
    return f"{value:.4g}"


@register.filter
def tone(status: str) -> str:
    """The colour of a trial's status, by the name the style sheets have for it."""
    return TrialStatus(status).tone


@register.filter
def what_next(status: str) -> str:
    """What a person can do about a trial in this status."""
    return advice(status)
