"""Template tags for times: in the lab's time zone, which is said wherever somebody looks for it."""

from __future__ import annotations

from datetime import date, datetime

from django import template
from django.template.defaultfilters import date as written
from django.utils import timezone
from django.utils.html import format_html

register = template.Library()


@register.simple_tag
def lab_zone() -> str:
    """The time zone of the lab, with what it is ahead of UTC now."""
    return f"{timezone.get_default_timezone_name()}{_offset(timezone.localtime())}"


@register.simple_tag
def zone_name() -> str:
    """The name of the lab's time zone, for scripts."""
    return timezone.get_default_timezone_name()


@register.simple_tag
def when(moment: datetime | date | None, form: str = "Y-m-d H:i", nothing: str = "–") -> str:
    """A time or a day as `form` has it, with all of it and the time zone on hover; `nothing` where there is none."""
    if not moment:
        return nothing
    if not isinstance(moment, datetime):
        return format_html('<time datetime="{}">{}</time>', moment.isoformat(), written(moment, form))
    here = timezone.localtime(moment)
    title = f"{here:%Y-%m-%d %H:%M:%S} {timezone.get_default_timezone_name()}{_offset(here)}"
    return format_html(
        '<time datetime="{}" title="{}">{}</time>',
        here.isoformat(timespec="seconds"),
        title,
        written(here, form),
    )


def _offset(moment: datetime) -> str:
    """Such as " (UTC+01:00)"; nothing in UTC itself."""
    ahead = moment.strftime("%z")
    return f" (UTC{ahead[:3]}:{ahead[3:5]})" if timezone.get_default_timezone_name() != "UTC" else ""
