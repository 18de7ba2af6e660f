"""What others say of a recording is kept from whoever may still have to judge its trial."""

import pytest
from django.test import Client
from django.urls import reverse

from evaweb.blinding.visibility import visibility_for_user
from evaweb.episodes.selectors import episode_get, episode_list, tag_counts
from evaweb.plans.allocation import allocate_trial
from evaweb.plans.models import Plan
from evaweb.plans.services import close_plan, freeze_plan, reveal_plan
from evaweb.results.ratings import rating_queue
from evaweb.reviews.services import add_review, save_segment, tags_change
from evaweb.trials import services
from tests.evaweb.trials import builders


@pytest.fixture
def bob(db):
    return builders.user("bob")


@pytest.fixture
def trial(bench, draft, owner, bob):
    """One of a blind plan, run and scored by ann; bob has said three things of it, and she one."""
    frozen = freeze_plan(user=owner, plan=draft)
    made = allocate_trial(user=bench.operator, station=bench.station, plan=frozen).trial
    builders.finished_trial(made, 9.0, cameras=["front"])
    services.score_trial(user=bench.operator, trial=made, milestones=bench.ticks(True, False, False))
    tags_change(user=bob, episode=made.episode, add=["slips"])
    tags_change(user=bench.operator, episode=made.episode, add=["dark"])
    add_review(user=bob, episode=made.episode, verdict="fail", note="it slips here", frame=12)
    save_segment(user=bob, episode=made.episode, first=3, last=9, label="reach")
    add_review(user=bench.operator, episode=made.episode, verdict="note", note="the lamp was off")
    return made


def said(user, episode):
    browser = Client()
    browser.force_login(user)
    return browser.get(reverse("api:episode-reviews", args=[episode.uuid])).json()


def words(user, episode):
    found = said(user, episode)
    return [review["note"] for review in found["reviews"]], len(found["segments"]), found["covered"]


def test_before_the_reveal_everybody_reads_their_own(bench, trial, owner, bob):
    assert words(bench.operator, trial.episode) == (["the lamp was off"], 0, 2)
    assert words(bob, trial.episode) == (["it slips here"], 1, 1)
    assert (said(bench.operator, trial.episode)["verdict"], said(bob, trial.episode)["verdict"]["note"]) == (
        None,
        "it slips here",
    )
    ann, row = visibility_for_user(bench.operator), episode_get(uuid=trial.episode.uuid)
    assert (ann.tags_of(row), tag_counts(sight=ann)) == (["dark"], {"dark": 1})
    assert [episode_list(tag=tag, sight=ann).count() for tag in ("dark", "slips")] == [1, 0]
    assert [
        episode_list(review="fail", sight=visibility_for_user(user)).count() for user in (bench.operator, bob)
    ] == [
        0,
        1,
    ]
    browser = Client()
    browser.force_login(bench.operator)
    page = browser.get("/replay/").content.decode()
    assert ("What others say of a blind trial" in page, "slips" in page) == (True, False)
    plan = Plan.objects.get()
    close_plan(user=owner, plan=plan, reason="enough")
    reveal_plan(user=owner, plan=plan)
    assert words(bench.operator, trial.episode) == (["the lamp was off", "it slips here"], 1, 0)
    assert visibility_for_user(bench.operator).tags_of(episode_get(uuid=trial.episode.uuid)) == [
        "dark",
        "slips",
    ]


def test_whoever_may_be_asked_to_rate_it_again_reads_their_own_first(bench, draft, owner, bob):
    Plan.objects.filter(pk=draft.pk).update(blind=False, second_rater_share=1.0)
    frozen = freeze_plan(user=owner, plan=Plan.objects.get())
    made = allocate_trial(user=bench.operator, station=bench.station, plan=frozen).trial
    builders.finished_trial(made, 9.0, cameras=["front"])
    add_review(user=bench.operator, episode=made.episode, verdict="note", note="it slips")
    services.score_trial(user=bench.operator, trial=made, milestones=bench.ticks(True, False, False))
    vic = builders.user("vic", "viewer")
    assert [words(user, made.episode)[0] for user in (bob, vic)] == [[], ["it slips"]]
    rating_queue.Rating.objects.create(
        trial=made, rater=bob, success=False, score=0.25, milestones=[], blind=False
    )
    assert words(bob, made.episode)[0] == ["it slips"]
