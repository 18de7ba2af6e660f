"""Visible parts of a preflight, for pages and REST.

Addresses, times, sizes and names in a preflight reveal a server's checkpoint. Only operators and administrators see
them, and of these not the users from whom a blind plan hides the checkpoint.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from evaweb.accounts.roles import Role, role_of
from evaweb.blinding.visibility import visibility_for_user
from evaweb.preflights.models import Preflight
from evaweb.trials.models import Checkpoint

_TOLD = ("verdict", "stage", "advice", "ok")  # keys of a report that everybody may see


@dataclass(frozen=True, slots=True)
class VisiblePreflight:
    """Preflight as one user may see it; `hidden` is the reason why `report` and `reason` are reduced, or ""."""

    row: Preflight
    report: dict[str, Any] | None
    reason: str
    hidden: str


def visible_preflight(row: Preflight, user: Any) -> VisiblePreflight:
    """Return the preflight as this user may see it."""
    reason = hidden_reason(row.checkpoint, user)
    if not reason:
        return VisiblePreflight(row, row.report, row.reason, "")
    report = None if row.report is None else {key: row.report[key] for key in _TOLD if key in row.report}
    return VisiblePreflight(row, report, "it ended without a report" if row.reason else "", reason)


def hidden_reason(checkpoint: Checkpoint, user: Any) -> str:
    """Return the reason why this user sees only the outcome of a preflight; "" if they see everything."""
    if role_of(user) is Role.VIEWER:
        return "addresses and times are shown to operators"
    visibility = visibility_for_user(user)
    return (
        f"addresses and times are hidden: {visibility.plans}"
        if checkpoint.pk in visibility.checkpoints
        else ""
    )
