"""Template tags for translated text, in the language that the browser has chosen."""

from __future__ import annotations

from typing import Any

from django import template
from django.template.base import FilterExpression, NodeList, Parser, Token, token_kwargs
from django.utils.html import conditional_escape
from django.utils.safestring import SafeString, mark_safe

from evaweb.core import languages

register = template.Library()


@register.simple_tag(takes_context=True)
def localized(context: Any, sentence: object) -> str:
    """Return a sentence, or the message of an error, in the chosen language; English if it has no translation."""
    request = context.get("request")
    return languages.translated(str(sentence), languages.chosen(request) if request else None)


@register.simple_tag(takes_context=True)
def label(context: Any, text: object) -> str:
    """Return a column header, filter name or choice in the chosen language."""
    request = context.get("request")
    return languages.label(str(text), languages.chosen(request) if request else None)


@register.simple_tag(takes_context=True)
def language_choice(context: Any) -> dict[str, Any]:
    """Return the offered languages and the code of the chosen one, "" for English."""
    spoken = languages.chosen(context["request"])
    return {"offered": languages.offered(), "chosen": spoken.code if spoken else ""}


class TextNode(template.Node):
    """English markup that a language may replace: `{% t "home.robots" n=count %}...{% endt %}`.

    The translation is markup too, with `{n}` for each value that the tag names.
    """

    def __init__(self, id: str, values: dict[str, FilterExpression], english: NodeList) -> None:
        self.id, self.values, self.english = id, values, english

    def render(self, context: Any) -> SafeString:
        """Return the markup of the chosen language, else the English one."""
        request = context.get("request")
        spoken = languages.chosen(request) if request is not None else None
        pattern = spoken.templates.get(self.id) if spoken is not None else None
        if pattern is None:
            return self.english.render(context)
        values = {name: self._shown(value, context, spoken) for name, value in self.values.items()}
        return mark_safe(pattern.format_map(values))

    def _shown(self, value: FilterExpression, context: Any, spoken: languages.Language | None) -> str:
        resolved = value.resolve(context)
        if isinstance(resolved, str):
            of_a_choice = "_display" in value.token
            resolved = (
                languages.label(resolved, spoken) if of_a_choice else languages.translated(resolved, spoken)
            )
        return conditional_escape(resolved)


@register.tag("t")
def text(parser: Parser, token: Token) -> TextNode:
    """Compile `{% t "id" name=value ... %}English{% endt %}`. Raises: TemplateSyntaxError for any other form."""
    _, id, *further = (*token.split_contents(), "")
    values = token_kwargs(bits := [bit for bit in further if bit], parser)
    if bits or len(id) < 3 or id[0] != id[-1] or id[0] not in "'\"":
        raise template.TemplateSyntaxError(
            f't: expected "an.id" and name=value pairs, given {token.contents}'
        )
    english = parser.parse(("endt",))
    parser.delete_first_token()
    return TextNode(id[1:-1], values, english)
