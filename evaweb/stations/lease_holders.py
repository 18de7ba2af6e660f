"""Names of lease holders: web:USER:PAGE for a page, any other for a terminal or a script."""

from __future__ import annotations

import re

from runtime.core.sentences import rewritten

_PAGE = re.compile(r"\bweb:([^:\s]+):[A-Za-z0-9_-]+")


def holder_of(username: str, page: str) -> str:
    """Return the holder name of a page."""
    return f"web:{username}:{page}"


def holder_display_name(holder: str) -> str:
    """Return a lease holder's name as it is shown to users.

    If the holder is a page, this is the user's name; any other name is unchanged.
    """
    return holder.split(":")[1] if holder.startswith("web:") else holder


def with_display_names(reason: str) -> str:
    """Return a message in which each holder name of a page (web:USER:PAGE) is replaced by the user name."""
    return rewritten(reason, lambda text: _PAGE.sub(r"\1", text))
