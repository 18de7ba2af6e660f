"""What fits, and how well."""

import pytest

from evaweb.find.ranking import Rank, rank, words_of


@pytest.mark.parametrize(
    ("query", "name", "more", "found"),
    [
        ("Bench-1", "bench-1", "", Rank.EXACT),
        ("  cups   on ", "Cups on a shelf", "", Rank.PREFIX),
        ("shelf cups", "Cups on a shelf", "", Rank.WORD),
        ("helf", "Cups on a shelf", "", Rank.INSIDE),
        ("cups plan", "Cups", "plan", Rank.WORD),
        ("cups saucers", "Cups", "plan", None),
        ("block-on", "2 block-on-plate", "", Rank.WORD),
        ("%", "everything", "", None),
    ],
)
def test_a_text_is_as_near_as_its_beginning(query, name, more, found):
    assert rank(query, name, more) is found


def test_each_word_counts_once():
    assert words_of("A b  a B") == ["a", "b"]
