"""Names of lease holders: web:USER:PAGE for a page, any other for a terminal or a script."""

from __future__ import annotations

import re

from runtime.core.sentences import rewritten

_PAGE = re.compile(r"\bweb:([^:\s]+):[A-Za-z0-9_-]+")


def holder_of(username: str, page: str) -> str:
    """The name under which a page holds a lease."""
    return f"web:{username}:{page}"


def holder_display_name(holder: str) -> str:
    """A holder's name as people know it."""
    return holder.split(":")[1] if holder.startswith("web:") else holder


def with_display_names(reason: str) -> str:
    """A sentence of the runtime with people's names where it names their pages."""
    return rewritten(reason, lambda text: _PAGE.sub(r"\1", text))
