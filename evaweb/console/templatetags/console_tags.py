"""Template tags of every page's bar: tabs, and the user's role."""

from __future__ import annotations

from typing import Any

from django import template

from evaweb.accounts.roles import role_of
from evaweb.console import tabs

register = template.Library()


@register.inclusion_tag("console/tabs.html", takes_context=True)
def tab_bar(context: template.Context) -> dict[str, Any]:
    """Render the tabs, with the one that this address belongs to."""
    return {"tabs": tabs.page_tabs(context["request"]), "request": context["request"]}


@register.simple_tag
def role_name(user: Any) -> str:
    """Return the highest role of a user."""
    return role_of(user).value
