"""Template tags for sentences: in the language that the browser has chosen."""

from __future__ import annotations

from typing import Any

from django import template

from evaweb import languages

register = template.Library()


@register.simple_tag(takes_context=True)
def said(context: Any, sentence: object) -> str:
    """The sentence, or that of an error, in the chosen language; English where that has no words for it."""
    request = context.get("request")
    return languages.translated(str(sentence), languages.chosen(request) if request else None)


@register.simple_tag(takes_context=True)
def language_choice(context: Any) -> dict[str, Any]:
    """The languages that are offered, and the code of the one that is chosen; "" for English."""
    spoken = languages.chosen(context["request"])
    return {"offered": languages.offered(), "chosen": spoken.code if spoken else ""}
