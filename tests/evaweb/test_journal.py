"""Lines are written as they were by earlier versions, and every column of a trial leads somewhere."""

import json
from dataclasses import replace
from typing import Annotated, get_args
from uuid import uuid4

import pytest
from django.core.exceptions import FieldDoesNotExist

from evaweb.blinding import EVERYTHING, HIDDEN, Sight
from evaweb.collect.models import SessionEvent
from evaweb.collect.record import EventLine
from evaweb.errors import EvaError
from evaweb.results.models import Preference, Rating
from evaweb.results.ratings.record import PreferenceLine, RatingLine
from evaweb.reviews.models import Review, Segment
from evaweb.reviews.record import REVIEWS, ReviewLine, SegmentLine
from evaweb.trials.models import Score, Trial
from evaweb.trials.record import COLUMNS, HINTS, Column, OutcomeLine, ScoreLine, TrialRecord, VoidLine
from tests.evaweb.test_data_of_before import HERE, report
from tests.evaweb.trials import builders

__all__ = ["report"]

pytestmark = pytest.mark.django_db


def before(folder, kind):
    lines = [
        json.loads(line)
        for file in sorted((HERE / "disk" / folder).iterdir())
        for line in file.read_text("utf-8").splitlines()
    ]
    return [line for line in lines if line.get("kind") == kind or kind == "any"]


def _score(row):
    return ScoreLine.written(row, milestones=[OutcomeLine.written(each) for each in row.outcomes.all()])


def _in_order(lines):
    return sorted(json.dumps(line, sort_keys=True) for line in lines)


_TRIALS = ("trial", "first", "second")


def _then(line):
    """What was known of its trials then; without the reason, another one when it was written, and how a station is."""
    known = before("scores", "score")[0]["trial"].keys() - {"reason", "simulated"}
    return {name: _only(known, value) if name in _TRIALS else value for name, value in line.items()}


def _only(known, said):
    return {name: value for name, value in said.items() if name in known}


@pytest.mark.parametrize(
    ("folder", "kind", "rows", "written"),
    [
        ("scores", "score", lambda: Score.objects.all(), _score),
        ("scores", "void", lambda: Trial.objects.filter(status="voided"), VoidLine.written),
        ("scores", "rating", lambda: Rating.objects.all(), RatingLine.written),
        ("scores", "preference", lambda: Preference.objects.all(), PreferenceLine.written),
        ("reviews", "review", lambda: Review.objects.all(), ReviewLine.written),
        ("sessions", "any", lambda: SessionEvent.objects.all(), EventLine.written),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_row_is_written_as_the_line_that_it_was_restored_from(report, folder, kind, rows, written):
    expected = [_then(line) for line in before(folder, kind)]
    if kind == "any":  # as the session is now, not as it was opened
        expected = [{**line, "target": 7} if "target" in line else line for line in expected]
    assert expected
    assert _in_order(_then(written(row)) for row in rows()) == _in_order(expected)


def test_a_segment_is_written_as_its_newest_line(report):
    line = SegmentLine.written(Segment.objects.get())
    assert line in before("reviews", "segment")


def test_a_column_that_came_later_has_its_default():
    class Later(TrialRecord):
        operator_note: Annotated[str, Column()] = "none was asked for"

    line = before("scores", "score")[0]
    assert Later.model_validate(line["trial"]).operator_note == "none was asked for"


def test_what_a_later_version_has_written_is_left_alone(report):
    line = before("reviews", "review")[0]
    assert ReviewLine.model_validate({**line, "colour": "red"}) == ReviewLine.model_validate(line)


def test_a_line_of_a_kind_that_nobody_writes_is_named():
    with pytest.raises(EvaError, match="line 1 of its reviews: kind is 'shout'; allowed: review, segment,"):
        REVIEWS.parsed(uuid4(), [{"kind": "shout"}])


@pytest.mark.parametrize("name", COLUMNS)
def test_every_column_of_a_trial_leads_to_a_field(name):
    model = Trial
    for part in TrialRecord.path_of(name).split("__"):
        try:
            field = model._meta.pk if part == "pk" else model._meta.get_field(part)
        except FieldDoesNotExist:
            field = next(each for each in model._meta.concrete_fields if each.attname == part)
        model = field.related_model
    read, column = TrialRecord.model_fields[name], COLUMNS[name]
    if name not in ("id", "prepared_at") and column.written != "never":  # of these the database has its own
        assert read.is_required() or field.null or read.default is not None, "no row can be made without it"


@pytest.mark.parametrize(
    "name", [name for name, column in COLUMNS.items() if not (column.open or column.seen)]
)
def test_what_may_be_hidden_can_be_nothing_or_a_word(name):
    assert HINTS[name] is str or type(None) in get_args(HINTS[name])


def test_what_is_not_said_to_be_open_is_hidden_with_the_checkpoint(bench):
    trial = bench.prepare()
    blind = Sight(checkpoints=frozenset({trial.checkpoint_id}))
    column = Column("instruction")
    assert column.shown("words", str, trial, EVERYTHING) == trial.instruction
    assert column.shown("words", str, trial, blind) == HIDDEN
    assert column.shown("words", str | None, trial, blind) is None
    assert replace(column, open=True).shown("words", str, trial, blind) == trial.instruction


def test_a_trial_is_asked_for_with_what_is_known_before_its_run(bench):
    trial = bench.ended()
    assert TrialRecord.written(trial).keys() - TrialRecord.asked(trial).keys() == {
        *("reason", "duration_s", "started_at", "ended_at", "truth")
    }
    assert builders.BOOT not in json.dumps(TrialRecord.asked(trial))
