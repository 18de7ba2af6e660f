"""Lines are written as they were by earlier versions, and every column of a trial leads somewhere."""

import json
import os
import resource
import signal
import stat
from dataclasses import replace
from typing import Annotated, get_args
from uuid import uuid4

import pytest
from django.core.exceptions import FieldDoesNotExist

from evaweb.blinding.visibility import FULL_VISIBILITY, HIDDEN, Visibility
from evaweb.collect.models import SessionEvent
from evaweb.collect.record import EventLine
from evaweb.records.journal import NotWritten
from evaweb.results.models import Preference, Rating
from evaweb.results.ratings.record import RATINGS, PreferenceLine, RatingLine
from evaweb.reviews.models import Review, Segment
from evaweb.reviews.record import REVIEWS, ReviewLine, SegmentLine
from evaweb.trials.models import Score, Trial
from evaweb.trials.record import (
    COLUMNS,
    HINTS,
    JUDGEMENTS,
    Column,
    OutcomeLine,
    ScoreLine,
    TrialRecord,
    VoidLine,
)
from tests.evaweb.data_of_before.reading import HERE
from tests.evaweb.test_data_of_before import report
from tests.evaweb.trials import builders

__all__ = ["report"]

pytestmark = pytest.mark.django_db


def before(folder, kind):
    lines = [
        json.loads(line)
        for file in sorted((HERE / "disk" / folder).iterdir())
        for line in file.read_text("utf-8").splitlines()
    ]
    return [line for line in lines if kind in ("any", line.get("kind"))]


def _score(row):
    return ScoreLine.written(row, milestones=[OutcomeLine.written(each) for each in row.outcomes.all()])


def _in_order(lines):
    return sorted(json.dumps(line, sort_keys=True) for line in lines)


_TRIALS = ("trial", "first", "second")
_LATER = ("failure_phase", "frame")  # not in the lines of then


def _then(line):
    """What was known of its trials then; without the reason, another one when it was written, and how a station is."""
    known = before("scores", "score")[0]["trial"].keys() - {"reason", "simulated"}
    return {
        name: _only(known, value) if name in _TRIALS else value
        for name, value in line.items()
        if name not in _LATER
    }


def _only(known, said):
    return {name: value for name, value in said.items() if name in known}


@pytest.mark.some(1)
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
    assert Later.model_validate_json(json.dumps(line["trial"])).operator_note == "none was asked for"


def test_what_a_later_version_has_written_is_left_alone(kept):
    line = before("reviews", "review")[0]
    assert kept(REVIEWS, {**line, "colour": "red"}) == kept(REVIEWS, line) != ([], [])


@pytest.fixture
def kept(settings, tmp_path):
    """What is read of such a line, between two that are whole, and what is said of it."""
    settings.DATA_DIR = tmp_path

    def read(journal, line):
        uuid, said = uuid4(), []
        path = journal.path(uuid)
        path.parent.mkdir(exist_ok=True)
        text = line if isinstance(line, bytes) else json.dumps(line).encode()
        good = json.dumps(before(journal.folder, "any")[0]).encode()
        path.write_bytes(b"\n".join([good, b"", b'{"torn', text, good]))
        first, *found, last = journal.read(uuid, said.append)
        assert first == last
        assert said.pop(0).startswith(f"{path}: line 3 is not whole and was left out: EOF")
        assert all(each.startswith(f"{path}: line 4 ") for each in said)
        return found, [each.removeprefix(f"{path}: line 4 ") for each in said]

    return read


def _nested(levels):
    return b"[" * levels + b"]" * levels


SCORE = before("scores", "score")[0]
TRIAL = SCORE["trial"]
JUDGED = {
    **{name: SCORE[name] for name in ("uuid", "trial", "at")},
    "kind": "judgement",
    "judge": "seer",
    "version": "chat 1, x",
    "prompt": "a" * 64,
    "milestones": [["held", True, 0.9], ["lifted", None, None]],
    "pictures": [["camera 1", 0, "b" * 64]],
}


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (
            {**SCORE, "kind": "scorE"},
            "Input tag 'scorE' found using 'kind' does not match any of the expected tags",
        ),
        ({**SCORE, "kind": ["score"]}, "found using 'kind' does not match"),
        ({"hello": 1}, "Unable to extract tag using discriminator 'kind'"),
        (b"[1, 2]", "Input should be an object"),
        (_nested(200_000), "is not whole and was left out: recursion limit exceeded"),
        (
            json.dumps(SCORE).encode().replace(b'"truth": null', b'"x": ' + _nested(5000)),
            "recursion limit exceeded",
        ),
        ({**SCORE, "note": "\ud800"}, "unexpected end of hex escape"),
        ({**SCORE, "note": "a\0b"}, "score.note is 'a\\x00b': Value error, it contains the character U+0000"),
        ({**SCORE, "at": "0001-01-01T00:00:00+14:00"}, "score.at is '0001-01-01T00:00:00+14:00'"),
        ({**SCORE, "at": "9999-12-31T23:59:59-14:00"}, "in the years 1900 to 9998"),
        ({**SCORE, "at": "2026"}, "score.at is '2026'"),
        ({**SCORE, "at": "2026-01-01T00:00:00"}, "with a time zone"),
        ({**SCORE, "at": 5}, "score.at is 5"),
        ({**SCORE, "score": True}, "score.score is True"),
        ({**SCORE, "milestones": 2 * SCORE["milestones"]}, "allowed: each milestone once"),
        ({**SCORE, "score": "0.5"}, "score.score is '0.5'"),
        ({**SCORE, "score": float("nan")}, "score.score is nan"),
        ({**SCORE, "trial": {**TRIAL, "id": 2**53}}, "score.trial.id is 9007199254740992"),
        ({**SCORE, "trial": {**TRIAL, "duration_s": -1e308}}, "score.trial.duration_s is -1e+308"),
        ({**SCORE, "trial": {**TRIAL, "station": "../x"}}, "score.trial.station is '../x'"),
        ({**SCORE, "trial": {**TRIAL, "truth": {"a": [float("nan")]}}}, "score.trial.truth is {'a': [nan]}"),
        ({**SCORE, "trial": {**TRIAL, "truth": {"a\0": 1}}}, "U+0000"),
        ({**JUDGED, "milestones": [["held", True, 1.5]]}, "judgement.milestones.0.2 is 1.5"),
        ({**JUDGED, "milestones": [["held", True, float("nan")]]}, "judgement.milestones.0.2 is nan"),
        ({**JUDGED, "milestones": [["held", 1, 0.5]]}, "judgement.milestones.0.1 is 1"),
        ({**JUDGED, "pictures": [["camera 1", 0.0, "../x"]]}, "judgement.pictures.0.2 is '../x'"),
        ({**JUDGED, "prompt": "x"}, "judgement.prompt"),
        ({**JUDGED, "judge": ""}, "judgement.judge is ''"),
    ],
)
def test_a_line_that_cannot_be_kept_is_named_and_stops_no_other(kept, line, words):
    found, said = kept(JUDGEMENTS, line)
    assert (found, len(said)) == ([], 1)
    assert words in said[0]


def test_what_a_judge_said_is_read_as_it_was_written(kept):
    (line,), said = kept(RATINGS, JUDGED)
    assert (line.milestones, said) == ((("held", True, 0.9), ("lifted", None, None)), [])


def test_a_part_does_not_end_before_it_begins(kept):
    line = before("reviews", "segment")[0]
    assert kept(REVIEWS, {**line, "last": line["first"]})[1] == []
    assert "segment.last is 0" in kept(REVIEWS, {**line, "first": 1, "last": 0})[1][0]


FULL = OSError(28, "No space left on device")


@pytest.mark.parametrize("there", [b"", b"{}\n", b'{"torn'])
def test_what_the_disk_did_not_take_is_taken_back(settings, tmp_path, monkeypatch, there):
    settings.DATA_DIR, uuid, sync = tmp_path, uuid4(), os.fsync
    path = REVIEWS.path(uuid)
    path.parent.mkdir()
    path.write_bytes(there)

    def fail_once(descriptor):
        if there or stat.S_ISDIR(os.fstat(descriptor).st_mode):  # of a new file its folder too
            monkeypatch.setattr(os, "fsync", sync)
            raise FULL
        sync(descriptor)

    monkeypatch.setattr(os, "fsync", fail_once)
    with pytest.raises(NotWritten, match="; nothing was changed"):
        REVIEWS.append(uuid, {})
    assert path.read_bytes() == there


def test_of_a_line_that_is_half_on_the_disk_nothing_stays(settings, tmp_path):
    settings.DATA_DIR, uuid, longest = tmp_path, uuid4(), 8 * 2**20
    REVIEWS.append(uuid, {"first": 1})
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (longest, limit[1]))
    try:
        with pytest.raises(NotWritten, match="; nothing was changed"):
            REVIEWS.append(uuid, {"second": "x" * longest})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
        signal.signal(signal.SIGXFSZ, ignored)
    assert REVIEWS.path(uuid).read_bytes() == b'{"first":1}\n'


def test_what_cannot_be_taken_back_is_said_to_be_there(settings, tmp_path, monkeypatch):
    settings.DATA_DIR = tmp_path

    def broken(descriptor):
        raise FULL

    monkeypatch.setattr(os, "fsync", broken)
    with pytest.raises(NotWritten, match="could not be removed: the next reconcile may read it as valid"):
        REVIEWS.append(uuid4(), {})


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
    "name", [name for name, column in COLUMNS.items() if not (column.always_visible or column.masked_value)]
)
def test_what_may_be_hidden_can_be_nothing_or_a_word(name):
    assert HINTS[name] is str or type(None) in get_args(HINTS[name])


def test_what_is_not_said_to_be_open_is_hidden_with_the_checkpoint(bench):
    trial = bench.prepare()
    blind = Visibility(checkpoints=frozenset({trial.checkpoint_id}))
    column = Column("instruction")
    assert column.shown("words", str, trial, FULL_VISIBILITY) == trial.instruction
    assert column.shown("words", str, trial, blind) == HIDDEN
    assert column.shown("words", str | None, trial, blind) is None
    assert replace(column, always_visible=True).shown("words", str, trial, blind) == trial.instruction


def test_a_trial_is_asked_for_with_what_is_known_before_its_run(bench):
    trial = bench.ended()
    assert TrialRecord.written(trial).keys() - TrialRecord.for_manifest(trial).keys() == {
        *("reason", "duration_s", "started_at", "ended_at", "ended_by", "truth")
    }
    assert builders.BOOT not in json.dumps(TrialRecord.for_manifest(trial))
