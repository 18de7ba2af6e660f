"""Reads of profiles."""

from __future__ import annotations

from collections.abc import Iterable

from evaweb.accounts.models import Profile


def orcids_of(usernames: Iterable[str]) -> dict[str, str]:
    """Return a dict from username to ORCID iD of those who have stated one."""
    rows = Profile.objects.filter(user__username__in=list(usernames)).exclude(orcid="")
    return dict(rows.values_list("user__username", "orcid"))
