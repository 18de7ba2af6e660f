"""Which bytes a Range asks for, after RFC 9110."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaweb.episodes.http_ranges import (
    Span,
    Unsatisfiable,
    Validators,
    not_modified,
    range_holds,
    requested_range,
)

VALIDATORS = Validators('"a-b-c"', "Wed, 21 Oct 2015 07:28:00 GMT")


@pytest.mark.parametrize(
    ("header", "span"),
    [
        ("bytes=0-", Span(0, 99)),
        ("bytes=0-0", Span(0, 0)),
        ("bytes=10-19", Span(10, 19)),
        ("bytes=90-1000", Span(90, 99)),
        ("bytes=99-", Span(99, 99)),
        ("bytes=-1", Span(99, 99)),
        ("bytes=-100", Span(0, 99)),
        ("bytes=-5000", Span(0, 99)),
        ("BYTES=5-6", Span(5, 6)),
        ("bytes= 5-6 ", Span(5, 6)),
    ],
)
def test_one_range_is_understood(header: str, span: Span) -> None:
    assert requested_range(header, 100) == span


@pytest.mark.parametrize("header", ["bytes=100-", "bytes=100-200", "bytes=5000-", "bytes=-0"])
def test_a_range_behind_the_end_cannot_be_satisfied(header: str) -> None:
    with pytest.raises(Unsatisfiable):
        requested_range(header, 100)


@pytest.mark.parametrize(
    "header",
    [
        None,
        "",
        "bytes",
        "bytes=",
        "bytes=-",
        "bytes=9-5",
        "bytes=a-b",
        "bytes=1.5-2",
        "bytes=--5",
        "bytes=0-1,3-4",
        "rows=0-5",
        "bytes=٣-٤",
        "bytes=" + "9" * 40 + "-",
    ],
)
def test_anything_else_is_as_if_nothing_had_been_asked(header: str | None) -> None:
    assert requested_range(header, 100) is None


@given(st.integers(0, 300), st.integers(0, 300), st.integers(1, 200))
def test_a_span_lies_within_the_file_and_begins_where_it_was_asked_to(
    first: int, last: int, size: int
) -> None:
    try:
        span = requested_range(f"bytes={first}-{last}", size)
    except Unsatisfiable:
        assert first >= size
        return
    if span is None:
        assert last < first
    else:
        assert first == span.first <= span.last == min(last, size - 1)
        assert span.length == len(range(span.first, span.last + 1))


@given(st.one_of(st.text(max_size=40), st.text("bytes=-0123456789, ", max_size=30)))
def test_no_header_breaks_it(header: str) -> None:
    try:
        span = requested_range(header, 50)
    except Unsatisfiable:
        return
    assert span is None or 0 <= span.first <= span.last < 50


def test_an_empty_file_satisfies_no_range() -> None:
    for header in ("bytes=0-", "bytes=-5"):
        with pytest.raises(Unsatisfiable):
            requested_range(header, 0)


@pytest.mark.parametrize(
    ("if_range", "holds"),
    [
        (None, True),
        (VALIDATORS.etag, True),
        (VALIDATORS.last_modified, True),
        ('W/"a-b-c"', False),
        ('"other"', False),
        ("Wed, 21 Oct 2015 07:28:01 GMT", False),
        ("nonsense", False),
    ],
)
def test_a_range_of_another_version_does_not_hold(if_range: str | None, holds: bool) -> None:
    assert range_holds(if_range, VALIDATORS) is holds


@pytest.mark.parametrize(
    ("none_match", "since", "known"),
    [
        (None, None, False),
        (VALIDATORS.etag, None, True),
        (f'"x", W/{VALIDATORS.etag}', None, True),
        ("*", None, True),
        ('"x"', VALIDATORS.last_modified, False),
        (None, VALIDATORS.last_modified, True),
        (None, "Wed, 21 Oct 2015 07:27:59 GMT", False),
        (None, "nonsense", False),
    ],
)
def test_who_has_this_version_is_told_so(none_match: str | None, since: str | None, known: bool) -> None:
    assert not_modified(none_match, since, VALIDATORS) is known


def test_another_file_in_the_same_place_has_another_tag(tmp_path: Path) -> None:
    path, other = tmp_path / "a", tmp_path / "b"
    for file in (path, other):
        file.write_bytes(b"same")
        os.utime(file, (1_700_000_000, 1_700_000_000))
    before = Validators.of(path.stat())
    assert before.last_modified == "Tue, 14 Nov 2023 22:13:20 GMT"
    other.replace(path)
    assert Validators.of(path.stat()).etag != before.etag
