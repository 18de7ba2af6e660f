"""Verdicts and annotations: on the disk before the row, never changed, each by somebody."""

import json

import pytest
from django.db import DatabaseError, transaction

from evaweb.core.errors import (
    Conflict,
    EvaError,
    NotAllowed,
    NotFound,
)
from evaweb.episodes.models import EpisodeStatus
from evaweb.records import journal as disk
from evaweb.reviews import selectors, services
from evaweb.reviews.models import Review, Segment, Standing
from tests.evaweb.episodes.conftest import FRAMES

pytestmark = pytest.mark.django_db


def said(data, episode):
    return [
        json.loads(line) for line in (data / "reviews" / f"{episode.uuid}.jsonl").read_text().splitlines()
    ]


def test_the_newest_pass_or_fail_counts_and_all_are_kept(closed, data, ann, bob):
    episode = closed()
    services.add_review(user=ann, episode=episode, verdict="pass")
    services.add_review(user=bob, episode=episode, verdict="fail", note="  it slips  ")
    services.add_review(user=ann, episode=episode, verdict="note", note="look at row 12")
    standing = selectors.get_standing(episode=episode)
    assert (standing.review.verdict, standing.review.note, standing.review.reviewer) == (
        "fail",
        "it slips",
        bob,
    )
    history = [(review.verdict, str(review.reviewer)) for review in selectors.reviews_of(episode=episode)]
    assert history == [("note", "ann"), ("fail", "bob"), ("pass", "ann")]
    assert [(line["verdict"], line["by"]) for line in said(data, episode)] == [
        ("pass", "ann"),
        ("fail", "bob"),
        ("note", "ann"),
    ]


def test_a_note_on_a_moment_keeps_its_frame(closed, data, ann):
    episode = closed()
    services.add_review(user=ann, episode=episode, verdict="note", note="it slips", frame=FRAMES - 1)
    services.add_review(user=ann, episode=episode, verdict="note", note="it slips", frame=3)
    services.add_review(user=ann, episode=episode, verdict="note", note="it slips", frame=3)  # asked again
    assert [line["frame"] for line in said(data, episode)] == [FRAMES - 1, 3]
    with pytest.raises(EvaError, match=f"frame = {FRAMES}; allowed: 0 to {FRAMES - 1}"):
        services.add_review(user=ann, episode=episode, verdict="note", note="it slips", frame=FRAMES)


def test_the_database_itself_keeps_what_was_said(closed, ann):
    review = services.add_review(user=ann, episode=closed(), verdict="pass")
    with pytest.raises(DatabaseError, match="never changed"), transaction.atomic():
        Review.objects.filter(pk=review.pk).update(verdict="fail")
    with pytest.raises(DatabaseError, match="never changed"), transaction.atomic():
        Review.objects.filter(pk=review.pk)._raw_delete("default")


def test_where_the_disk_does_not_take_it_nothing_is_changed(closed, ann, monkeypatch):
    episode = closed()

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(disk.NotWritten, match="No space left"):
        services.add_review(user=ann, episode=episode, verdict="pass")
    with pytest.raises(disk.NotWritten, match="No space left"):
        services.save_segment(user=ann, episode=episode, first=0, last=1, label="reach")
    assert not Review.objects.exists()
    assert not Segment.objects.exists()
    assert not Standing.objects.exclude(review=None).exists()


@pytest.mark.parametrize(
    ("verdict", "note", "sentence"),
    [
        ("maybe", "", "verdict = 'maybe'; allowed: pass, fail, note"),
        ("note", "  ", "a note needs words"),
        ("pass", "x" * 8001, "at most 8000"),
        ("fail", "a\x00b", "U\\+0000"),
    ],
)
def test_what_cannot_be_said_is_refused(closed, ann, verdict, note, sentence):
    with pytest.raises(EvaError, match=sentence):
        services.add_review(user=ann, episode=closed(), verdict=verdict, note=note)


def test_viewers_say_nothing(closed, vera):
    episode = closed()
    with pytest.raises(NotAllowed):
        services.add_review(user=vera, episode=episode, verdict="pass")
    with pytest.raises(NotAllowed):
        services.save_segment(user=vera, episode=episode, first=0, last=1, label="reach")


def test_what_is_being_recorded_is_not_reviewed(closed, ann):
    episode = closed()
    type(episode).objects.update(status=EpisodeStatus.RECORDING)
    episode.refresh_from_db()
    with pytest.raises(Conflict, match="still being recorded"):
        services.add_review(user=ann, episode=episode, verdict="pass")
    with pytest.raises(Conflict, match="still being recorded"):
        services.request_quality_check(episode=episode)


def test_several_annotators_mark_the_same_frames_each_their_own(closed, data, ann, bob, alma):
    episode = closed()
    reach = services.save_segment(
        user=ann, episode=episode, first=0, last=9, label="reach", milestone="cup touched"
    )
    services.save_segment(user=bob, episode=episode, first=2, last=11, label="approach")
    changed = services.save_segment(
        user=ann, episode=episode, first=0, last=8, label="reach", segment=reach.uuid
    )
    assert changed.uuid == reach.uuid
    told = [
        (row.first, row.last, row.label, str(row.annotator)) for row in selectors.segments_of(episode=episode)
    ]
    assert told == [(0, 8, "reach", "ann"), (2, 11, "approach", "bob")]
    with pytest.raises(NotAllowed, match="ann's"):
        services.remove_segment(user=bob, episode=episode, segment=reach.uuid)
    services.remove_segment(user=alma, episode=episode, segment=reach.uuid)
    assert [line["kind"] for line in said(data, episode)] == ["segment"] * 3 + ["segment_removed"]
    with pytest.raises(NotFound):
        services.remove_segment(user=ann, episode=episode, segment=reach.uuid)


@pytest.mark.parametrize(("first", "last"), [(-1, 3), (5, 4), (0, FRAMES)])
def test_segments_lie_within_the_episode(closed, ann, first, last):
    with pytest.raises(EvaError, match=f"allowed: frames 0 to {FRAMES - 1}"):
        services.save_segment(user=ann, episode=closed(), first=first, last=last, label="reach")


def test_a_segment_has_a_label(closed, ann):
    with pytest.raises(EvaError, match="label is empty"):
        services.save_segment(user=ann, episode=closed(), first=0, last=1, label=" ")


def test_the_next_unreviewed_goes_down_the_list_and_begins_again_at_its_top(closed, ann):
    newer, older = sorted(
        (closed("finished"), closed("interrupted")), key=lambda one: one.started_at, reverse=True
    )
    assert selectors.unreviewed_next(after=None) == (newer, 2)
    assert selectors.unreviewed_next(after=newer.uuid) == (older, 2)
    assert selectors.unreviewed_next(after=older.uuid) == (newer, 2)
    services.add_review(user=ann, episode=older, verdict="note", note="odd")
    assert selectors.unreviewed_next(after=newer.uuid) == (older, 2), "a note decides nothing"
    services.add_review(user=ann, episode=older, verdict="pass")
    assert selectors.unreviewed_next(after=newer.uuid) == (None, 1)
    services.add_review(user=ann, episode=newer, verdict="fail")
    assert selectors.unreviewed_next(after=None) == (None, 0)


def test_who_says_the_same_once_more_because_the_answer_was_lost_has_said_it_once(closed, data, ann, bob):
    episode = closed()
    first = services.add_review(user=ann, episode=episode, verdict="pass", note="clean")
    assert services.add_review(user=ann, episode=episode, verdict="pass", note="clean ") == first
    part = {"episode": episode, "first": 0, "last": 5, "label": "reach"}
    marked = services.save_segment(user=ann, **part)
    assert services.save_segment(user=ann, **part) == marked
    assert services.save_segment(user=ann, segment=marked.pk, **part) == marked
    assert services.save_segment(user=bob, **part) != marked, "another annotator sees the same"
    assert len(said(data, episode)) == 3
    services.add_review(user=bob, episode=episode, verdict="fail")
    assert services.add_review(user=ann, episode=episode, verdict="pass", note="clean") != first
