"""Template tags of every page's bar (tabs, the user's role), and of the wall."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from django import template
from django.http import HttpRequest
from django.urls import reverse

from evaweb.accounts.roles import role_of
from evaweb.console import selectors
from evaweb.console.home import alarms


@dataclass(frozen=True, slots=True)
class Tab:
    """One tab; `current` if the displayed page belongs to it."""

    title: str
    address: str
    current: bool


_STATION_TABS = (("Debug", "station-debug"), ("Collect", "station-collect"), ("Eval", "station-eval"))
_COLLECTING = "station-collect"  # present only if the station's deployment configures collecting
_LAB_TABS = (("Replay", "/replay/"), ("Result", "/result/"))


def page_tabs(request: HttpRequest) -> list[Tab]:
    """Return the tabs in order; station tabs lead to the station that this browser last used."""
    station = selectors.last_used_station(session=request.session)
    match = request.resolver_match
    name = match.url_name if match else ""
    at_station = [
        Tab(
            title,
            reverse(route, args=[station.name]) if station else reverse("home") + "#stations",
            name == route,
        )
        for title, route in _STATION_TABS
        if route != _COLLECTING or (station is not None and station.collects)
    ]
    in_lab = [Tab(title, address, request.path.startswith(address)) for title, address in _LAB_TABS]
    return at_station + in_lab


register = template.Library()


@register.inclusion_tag("console/tabs.html", takes_context=True)
def tab_bar(context: template.Context) -> dict[str, Any]:
    """Render the tabs; the one to which this address belongs is marked as current."""
    return {"tabs": page_tabs(context["request"]), "request": context["request"]}


@register.inclusion_tag("console/alarms.html", takes_context=True)
def lab_alarms(context: template.Context) -> dict[str, Any]:
    """Render the current alarms of the whole lab."""
    return {"now": {"alarms": list(alarms())}, "request": context["request"]}


@register.simple_tag
def role_name(user: Any) -> str:
    """Return the highest role of a user."""
    return role_of(user).value
