import csv
import io

import pytest
from asgiref.sync import async_to_sync
from django.test import AsyncRequestFactory, RequestFactory
from hypothesis import given
from hypothesis import strategies as st

from evaweb.api.tables import csv_cell, csv_response
from evaweb.results.reports.recompute import __main__ as recompute


@pytest.mark.parametrize(
    "text", ["=1+1", "+1", "-1", "@SUM(A1)", "\t=1", "\r=1", "\n=1", "\uff1d1", "=cmd|' /C calc'!A0"]
)
def test_no_text_is_a_formula(text):
    assert csv_cell(text) == f"'{text}"


@pytest.mark.parametrize("sign", ["", *"=+-@\t\r\n＝＋－＠"])
@pytest.mark.parametrize("before", ["", "'", "''", "a", "'a"])
def test_a_report_that_is_recomputed_reads_every_text_as_it_was(sign, before):
    text = f"{before}{sign}1"
    assert recompute._text(csv_cell(text)) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [(-1, "-1"), (-0.5, "-0.5"), (None, ""), (True, "true"), (False, "false"), ("", ""), ("a=b", "a=b")],
)
def test_numbers_stay_numbers_and_other_texts_what_they_are(value, text):
    assert csv_cell(value) == text


@given(st.lists(st.lists(st.text(st.characters(exclude_categories=["Cs"])), min_size=2, max_size=2)))
def test_whatever_is_written_is_read_back(rows):
    answer = csv_response(RequestFactory().get("/"), "x", ["a", "b"], [[{"a": a, "b": b} for a, b in rows]])
    text = b"".join(answer.streaming_content).decode()
    found = list(csv.reader(io.StringIO(text, newline="")))
    assert found[0] == ["a", "b"]
    assert [[part.removeprefix("'") for part in row] for row in found[1:]] == [
        [part.removeprefix("'") for part in row] for row in rows
    ]


def test_under_asgi_it_is_written_page_by_page():
    asked = []

    def pages():
        for n in range(3):
            asked.append(n)
            yield [{"a": n}]

    async def read():
        answer = csv_response(AsyncRequestFactory().get("/"), "x", ["a"], pages())
        assert answer.is_async
        return [(piece, len(asked)) async for piece in answer.streaming_content]

    assert async_to_sync(read)() == [(b"a\r\n", 0), (b"0\r\n", 1), (b"1\r\n", 2), (b"2\r\n", 3)]
