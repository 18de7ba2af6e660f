import pytest

from tests.lint.texts import left


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ('<p>{% t "a.b" n=rows %}{{ n }} rows{% endt %}</p>', []),
        ("<p>\n{{ n }} rows</p>", [(2, "rows")]),
        ('<a title="Show it" href="x">{% t "a.b" %}Show{% endt %}</a>', [(1, "Show it")]),
        ("{# a remark #}<code>make setup</code> <kbd>Esc</kbd> CSV {% block theme %}dark{% endblock %}", []),
        ("<input placeholder='train=0:40'>", []),
        ("{% if a %}yes{% else %}no{% endif %}", [(1, "yesno")]),
    ],
)
def test_a_text_without_an_id_is_named_with_its_line(source: str, found: list[tuple[int, str]]) -> None:
    assert left(source) == found
