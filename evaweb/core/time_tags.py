"""Template tags for times in the lab's time zone, which is shown on hover."""

from __future__ import annotations

from datetime import date, datetime

from django import template
from django.template.defaultfilters import date as written
from django.utils import timezone
from django.utils.html import format_html

register = template.Library()


@register.simple_tag
def lab_zone() -> str:
    """Return the lab's time zone with its current offset from UTC."""
    return f"{timezone.get_default_timezone_name()}{_offset(timezone.localtime())}"


@register.simple_tag
def zone_name() -> str:
    """Return the name of the lab's time zone, for scripts."""
    return timezone.get_default_timezone_name()


@register.simple_tag
def when(moment: datetime | date | None, form: str = "Y-m-d H:i", nothing: str = "–") -> str:
    """Return a `<time>` element in the format `form`, with full time and zone on hover; `nothing` without a time."""
    if not moment:
        return nothing
    if not isinstance(moment, datetime):
        return format_html('<time datetime="{}">{}</time>', moment.isoformat(), written(moment, form))
    local = timezone.localtime(moment)
    title = f"{local:%Y-%m-%d %H:%M:%S} {timezone.get_default_timezone_name()}{_offset(local)}"
    return format_html(
        '<time datetime="{}" title="{}">{}</time>',
        local.isoformat(timespec="seconds"),
        title,
        written(local, form),
    )


def _offset(moment: datetime) -> str:
    """Return the UTC offset such as " (UTC+01:00)", "" if the lab's zone is UTC."""
    ahead = moment.strftime("%z")
    return f" (UTC{ahead[:3]}:{ahead[3:5]})" if timezone.get_default_timezone_name() != "UTC" else ""
