"""Depth and size are bounded before anything is parsed; what is allowed is read as the parsers read it."""

import json
import tomllib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.core import bounded_documents as bounded
from runtime.core.bounded_documents import MAX_DEPTH, MAX_ITEMS, UnreadableDocument

DEEP = 20_000
TOML = {
    "a header": "[" + ".".join("a" * DEEP) + "]",
    "a key": ".".join("a" * DEEP) + " = 1",
    "a quoted key": ".".join(['"a"'] * DEEP) + " = 1",
    "lists": "x = " + "[" * DEEP + "]" * DEEP,
    "tables": "x = " + "{a = " * DEEP,
    "behind a string that ends in quotes": 'x = ["""a"""", ' + "[" * DEEP,
    "behind a literal that ends in quotes": "x = ['''a''''', " + "[" * DEEP,
    "behind a comment": "# '\nx = " + "[" * DEEP,
}


@pytest.mark.parametrize("text", TOML.values(), ids=TOML)
def test_deep_toml_is_refused_before_it_is_parsed(text, monkeypatch):
    monkeypatch.setattr(tomllib, "loads", lambda text: pytest.fail("it was parsed"))
    with pytest.raises(UnreadableDocument, match=f"^the file: line . has .* allowed: at most {MAX_DEPTH}$"):
        bounded.parse_toml(text, "the file")


@pytest.mark.parametrize("text", ["[" * DEEP, '{"a": ' * DEEP, '["\\"", ' * DEEP])
def test_deep_json_is_refused_before_it_is_parsed(text, monkeypatch):
    monkeypatch.setattr(json, "loads", lambda text: pytest.fail("it was parsed"))
    with pytest.raises(UnreadableDocument, match=f"^the body: .* allowed: at most {MAX_DEPTH}$"):
        bounded.parse_json(text, "the body")


@pytest.mark.parametrize(
    ("text", "parser", "read"),
    [
        ("[" + "[]," * MAX_ITEMS + "1]", json, bounded.parse_json),
        ("[" + "1," * MAX_ITEMS + "1]", json, bounded.parse_json),
        ("x = [" + "[]," * MAX_ITEMS + "]", tomllib, bounded.parse_toml),
        ("".join(f"a{number}=1\n" for number in range(MAX_ITEMS + 1)), tomllib, bounded.parse_toml),
    ],
)
def test_many_values_are_refused_before_they_are_parsed(text, parser, read, monkeypatch):
    monkeypatch.setattr(parser, "loads", lambda text: pytest.fail("it was parsed"))
    with pytest.raises(
        UnreadableDocument, match=rf"^the file: more than {MAX_ITEMS} values; allowed: at most {MAX_ITEMS}$"
    ):
        read(text, "the file")


def test_commas_and_brackets_in_texts_are_no_values():
    assert bounded.parse_json(json.dumps([",[" * 100]), "it", most=2) == [",[" * 100]
    with pytest.raises(UnreadableDocument, match="more than 2 values"):
        bounded.parse_json("[1, 2, 3]", "it", most=2)


@pytest.mark.parametrize("read", [bounded.parse_toml, bounded.parse_json])
def test_what_is_too_long_is_refused_with_the_bound(read):
    with pytest.raises(UnreadableDocument, match=r"^it: 11 characters; allowed: at most 10$"):
        read(" " * 11, "it", 10)


@pytest.mark.parametrize(
    "text",
    [
        "x = '" + "a." * 100 + "'",
        "# " + "[" * 100,
        'x = """\n' + "[" * 100 + '"""',
        "x = [" + ", ".join(["0.1"] * 100) + "]",
        "".join(f"[a{i}.b]\nc.d = [[1.5, 2.5], []]\n" for i in range(100)),
    ],
)
def test_signs_in_texts_and_numbers_are_no_depth(text):
    assert bounded.parse_toml(text, "it") == tomllib.loads(text)


@pytest.mark.parametrize("text", [b"\xff", "{", '{"a": ' + "1" * 5000 + "}"])
def test_what_is_no_json_says_so(text):
    with pytest.raises(UnreadableDocument, match=r"^the body: is not valid JSON: "):
        bounded.parse_json(text, "the body")


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**9), 10**9) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=12,
)


@given(VALUES)
def test_flat_json_is_read_as_it_was_written(value):
    assert bounded.parse_json(json.dumps(value), "it") == value


@given(st.text(alphabet="\"'[]{}.=#\\\na1 ", max_size=60))
def test_whatever_toml_a_parser_takes_is_taken_alike(text):
    try:
        expected = tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        with pytest.raises(UnreadableDocument):
            bounded.parse_toml(text, "it")
    else:
        assert bounded.parse_toml(text, "it") == expected


def test_a_file_that_never_ends_is_no_file(tmp_path):
    with pytest.raises(UnreadableDocument, match="is no file"):
        bounded.load_toml(type(tmp_path)("/dev/zero"), "it")
