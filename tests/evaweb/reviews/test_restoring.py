"""A lost database has its reviews, segments and reports again after reconcile; a second run changes nothing."""

import json

import pytest
from django.contrib.auth.models import User

from evaweb.episodes.models import Episode, Tag
from evaweb.episodes.reconcile import reconcile
from evaweb.jobs.models import Job
from evaweb.jobs.services import run_queue
from evaweb.reviews import services
from evaweb.reviews.models import Review, Segment, Standing
from tests.evaweb.unguarded import without_triggers

pytestmark = pytest.mark.django_db


def everything():
    return [
        list(model.objects.order_by("pk").values(*fields))
        for model, fields in (
            (Review, ("uuid", "episode", "verdict", "note", "reviewer__username", "at")),
            (
                Segment,
                ("uuid", "episode", "first", "last", "label", "milestone", "annotator__username", "at"),
            ),
            (Tag, ("uuid", "episode", "words", "by__username", "at")),
            (Standing, ("episode", "clean", "worst", "flags", "review", "checked_at")),
        )
    ]


@pytest.fixture
def spoken(closed, ann, bob):
    """An episode that was checked, reviewed twice and annotated."""
    episode = closed()
    services.request_quality_check(episode=episode)
    services.add_review(user=ann, episode=episode, verdict="pass")
    services.add_review(user=bob, episode=episode, verdict="fail", note="it slips")
    kept = services.save_segment(
        user=ann, episode=episode, first=0, last=9, label="reach", milestone="touched"
    )
    gone = services.save_segment(user=ann, episode=episode, first=10, last=12, label="wrong")
    services.save_segment(user=ann, episode=episode, first=1, last=9, label="reach", segment=kept.uuid)
    services.remove_segment(user=ann, episode=episode, segment=gone.uuid)
    services.tags_change(user=ann, episode=episode, add=["slips", "wrong"])
    services.tags_change(user=bob, episode=episode, remove=["wrong"])
    run_queue("cpu")
    return episode


def lose():
    """All rows, as a database that was lost has none; no trigger stands in the way."""
    with without_triggers("reviews"):
        for model in (Standing, Tag, Segment, Review, Episode, Job, User):
            model.objects.all().delete()


def test_what_was_said_comes_back_from_the_disk(spoken):
    before = everything()
    lose()
    report = reconcile()
    assert report.problems == ()
    assert report.restored == 4
    assert everything() == before
    assert Standing.objects.get().changed_at is not None, "it is to be published again"
    assert not User.objects.filter(is_active=True).exists(), "people that are gone come back switched off"
    assert reconcile().restored == 0
    assert everything() == before


def test_a_row_that_the_disk_knows_better_is_brought_up_to_it(spoken):
    before = everything()
    Segment.objects.update(label="from a backup")
    assert reconcile().restored == 1
    assert everything() == before


def test_a_torn_line_never_counted_and_a_wrong_one_is_named(spoken, data):
    path = data / "reviews" / f"{spoken.uuid}.jsonl"
    before = everything()
    number = path.read_bytes().count(b"\n") + 1
    path.write_bytes(path.read_bytes() + b'{"kind": "review", "uu')
    assert reconcile().problems == (
        f"{path}: line {number} is not whole and was left out: EOF while parsing a string",
    )
    assert everything() == before
    path.write_text(json.dumps({"kind": "review", "uuid": str(spoken.uuid), "verdict": "perhaps"}) + "\n")
    (problem,) = reconcile().problems
    assert problem.startswith(f"{path}: line 1 was left out: review.verdict is 'perhaps'")


def test_a_line_that_cannot_be_read_takes_nothing_from_the_database(spoken, data):
    path = data / "reviews" / f"{spoken.uuid}.jsonl"
    before = everything()
    path.write_bytes(path.read_bytes().replace(b'"label":"reach"', b'"label":5'))
    assert len(reconcile().problems) == 2
    assert everything() == before


def test_a_line_that_is_there_twice_is_one_review_and_the_last_counts(spoken, data):
    path = data / "reviews" / f"{spoken.uuid}.jsonl"
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join([lines[0].replace(b'"pass"', b'"fail"'), *lines, *lines]))
    before = everything()
    lose()
    report = reconcile()
    assert (report.problems, report.restored) == ((), 4)
    assert everything() == before
    assert reconcile().restored == 0


@pytest.mark.some(1)
@pytest.mark.parametrize("kind", ["review", "segment", "tag"])
def test_what_is_said_of_another_episode_is_named(spoken, data, closed, kind):
    other = closed("interrupted")
    lines = (data / "reviews" / f"{spoken.uuid}.jsonl").read_text().splitlines(keepends=True)
    line = next(line for line in lines if f'"kind":"{kind}"' in line)
    (data / "reviews" / f"{other.uuid}.jsonl").write_text(line)
    (problem,) = reconcile().problems
    assert f"its {kind} {json.loads(line)['uuid']} is of episode {spoken.uuid}" in problem


def test_a_damaged_report_is_named(spoken, data):
    Standing.objects.update(checked_at=None)
    (data / "quality" / f"{spoken.uuid}.json").write_text("{}")
    (problem,) = reconcile().problems
    assert "is no report" in problem
