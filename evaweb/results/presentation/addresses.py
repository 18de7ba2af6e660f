"""Addresses of three kinds of pages: a list of trials, a comparison, and recordings played side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from urllib.parse import urlencode

from django.urls import reverse

from evaweb.plans.models import Plan
from evaweb.results.analysis.comparison import Comparison
from evaweb.results.analysis.filters import TrialFilter
from evaweb.results.selectors import TrialQuery


def trials_address(plan: Plan, only: TrialFilter, **more: str) -> str:
    """Return the address of the list of the trials that the filter `only` selects."""
    question = TrialQuery(
        scene=only.scene, position=only.position, station=only.station, operator=only.operator
    )
    address = reverse("result-plan-trials", args=[plan.name, plan.version])
    return f"{address}?{replace(question, **more).query}"


def compare_address(plan: Plan, found: Comparison, only: TrialFilter) -> str:
    """Return the address of the page that compares both checkpoints."""
    query = urlencode({"first": found.first, "second": found.second})
    address = reverse("result-compare", args=[plan.name, plan.version])
    return f"{address}?{query}" + (f"&{only.query}" if only.query else "")


def side_by_side_url(episodes: Sequence[object]) -> str:
    """Return the address that plays recordings synchronously; "" for fewer than two."""
    if len(episodes) < 2:
        return ""
    return reverse("side-by-side") + "?" + urlencode([("show", str(uuid)) for uuid in episodes])
