"""Parts of a preflight that a user is shown: the one place that pages and REST ask.

Addresses, times, sizes and names tell which checkpoint a server has. They are for operators and administrators, but
for none from whom a blind plan hides what it hands out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from evaweb.blinding import visibility_for_user
from evaweb.preflights.models import Preflight
from evaweb.roles import Role, role_of
from evaweb.trials.models import Checkpoint

_TOLD = ("verdict", "stage", "advice", "ok")  # of a report, to everybody


@dataclass(frozen=True, slots=True)
class VisiblePreflight:
    """A preflight as one user sees it: `report` and `reason` without what `hidden` says is kept back and why."""

    row: Preflight
    report: dict[str, Any] | None
    reason: str
    hidden: str


def visible_preflight(row: Preflight, user: Any) -> VisiblePreflight:
    """The preflight as this user may see it."""
    why = hidden_reason(row.checkpoint, user)
    if not why:
        return VisiblePreflight(row, row.report, row.reason, "")
    report = None if row.report is None else {key: row.report[key] for key in _TOLD if key in row.report}
    return VisiblePreflight(row, report, "it ended without a report" if row.reason else "", why)


def hidden_reason(checkpoint: Checkpoint, user: Any) -> str:
    """Why a user is shown nothing but the verdict, "" where they are shown everything."""
    if role_of(user) is Role.VIEWER:
        return "addresses and times are shown to operators"
    seen = visibility_for_user(user)
    return f"addresses and times are hidden: {seen.plans}" if checkpoint.pk in seen.checkpoints else ""
