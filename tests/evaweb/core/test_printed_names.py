"""Names that are one line of plain text wherever they stand."""

import pytest
from django.core.exceptions import ValidationError

from evaweb.core.printed_names import check_name
from evaweb.plans.models import Plan
from evaweb.trials.models import Checkpoint, FailureTerm, Milestone, Position, Scene


@pytest.mark.parametrize(
    ("name", "character"),
    [
        ("two\nlines", "U+000A"),
        ("two\u2028lines", "U+2028"),
        ("bell\x07", "U+0007"),
        ("nul\x00", "U+0000"),
        ("next\x85", "U+0085"),
        ("gnp.\u202eexe", "U+202E"),
        ("isolated\u2066", "U+2066"),
        ("half\ud800", "U+D800"),
        ("none\ufffe", "U+FFFE"),
        ("none\uffff", "U+FFFF"),
    ],
)
def test_a_name_has_no_character_that_breaks_a_line_or_a_drawing_or_turns_it_around(name, character):
    with pytest.raises(
        ValidationError, match=rf"contains the character {character[0]}\{character[1:]}; allowed"
    ):
        check_name(name)


@pytest.mark.parametrize(
    "name", ["pi0_new v2.1", "方块 é", "a\u0301", "מדיניות", "\U0001f916", '<b> & "c"', ""]
)
def test_a_name_is_in_any_language(name):
    check_name(name)


@pytest.mark.parametrize(
    ("row", "field"),
    [
        (Checkpoint(), "name"),
        (Scene(), "title"),
        (Position(), "label"),
        (Milestone(), "text"),
        (Plan(), "title"),
        (FailureTerm(), "words"),
    ],
)
def test_every_name_of_a_figure_is_looked_at(row, field):
    setattr(row, field, "up\u202edown")
    with pytest.raises(ValidationError) as refused:
        row.clean_fields()
    assert "U+202E" in str(refused.value.message_dict[field])
