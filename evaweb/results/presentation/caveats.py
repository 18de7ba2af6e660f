"""Reasons to doubt a result, in one list for page, citation, report and REST."""

from __future__ import annotations

from evaweb.plans.models import Plan
from evaweb.results.presentation.headline import headline
from evaweb.results.presentation.integrity import delays_banner, integrity_document


def caveats_of(plan: Plan) -> list[str]:
    """Return the alternative headlines, then remarks on how the trials were made; [] without a comparison."""
    said = headline(plan)
    if said is None:
        return []
    record = integrity_document(plan)
    return [*said.caveats, *filter(None, [delays_banner(record)]), *record["remarks"]]
