"""Free words on episodes: put on and taken off by operators, found and filtered by, kept on the disk."""

import json

import pytest
from django.test import Client

from evaweb.blinding.visibility import Visibility, visibility_for_user
from evaweb.core.errors import Conflict, EvaError, NotAllowed
from evaweb.episodes.models import EpisodeStatus, Tag
from evaweb.episodes.selectors import episode_get, episode_list, tag_counts
from evaweb.find.selectors import find
from evaweb.reviews.services import MOST_TAGS, Tagged, tags_change

pytestmark = pytest.mark.django_db
BLIND = Visibility(checkpoints=frozenset({1}), names=frozenset({"Secret-birch"}))


def tags(episode):
    return list(Tag.objects.filter(episode=episode).values_list("words", flat=True))


def test_what_was_changed_is_told_so_that_it_can_be_undone(closed, ann, bob, data):
    episode = closed()
    assert tags_change(user=ann, episode=episode, add=["  Slips\tHere", "slips here", "cup"]) == Tagged(
        ("slips here", "cup"), ()
    )
    changed = tags_change(user=bob, episode=episode, add=["cup", "new"], remove=["SLIPS here", "never there"])
    assert changed == Tagged(("new",), ("slips here",))
    assert tags(episode) == ["cup", "new"]
    tags_change(user=bob, episode=episode, add=changed.removed, remove=changed.added)
    assert tags(episode) == ["cup", "slips here"]
    lines = map(json.loads, (data / "reviews" / f"{episode.uuid}.jsonl").read_text().splitlines())
    assert [(line["kind"], line.get("words"), line["by"]) for line in lines] == [
        ("tag", "slips here", "ann"),
        ("tag", "cup", "ann"),
        ("tag_removed", None, "bob"),
        ("tag", "new", "bob"),
        ("tag_removed", None, "bob"),
        ("tag", "slips here", "bob"),
    ]


@pytest.mark.parametrize("words", ["", " \t", "a, b", "x" * 61, "a\nb\u202ec", "ﬃ" * 40, "a\0b"])
def test_what_cannot_be_a_tag_is_refused_and_nothing_is_changed(closed, ann, words):
    episode = closed()
    with pytest.raises(EvaError, match="tag"):
        tags_change(user=ann, episode=episode, add=["good", words])
    assert tags(episode) == []


def test_viewers_tag_nothing_and_an_episode_has_only_so_many(closed, ann, vera):
    episode = closed()
    with pytest.raises(NotAllowed):
        tags_change(user=vera, episode=episode, add=["cup"])
    with pytest.raises(EvaError, match="add and remove both say cup"):
        tags_change(user=ann, episode=episode, add=["cup"], remove=["Cup"])
    tags_change(user=ann, episode=episode, add=[str(n) for n in range(MOST_TAGS)])
    with pytest.raises(Conflict, match="allowed: at most 30"):
        tags_change(user=ann, episode=episode, add=["one more"])
    tags_change(user=ann, episode=episode, add=["one more"], remove=["0"])
    episode.status = EpisodeStatus.RECORDING
    episode.save()
    with pytest.raises(Conflict, match="still being recorded"):
        tags_change(user=ann, episode=episode, add=["later"])


def test_the_list_is_narrowed_to_a_tag_and_shows_and_exports_them(closed, ann):
    episode, other = closed(), closed("interrupted")
    tags_change(user=ann, episode=episode, add=["cup & saucer", "slips"])
    tags_change(user=ann, episode=other, add=["slips"])
    assert tag_counts() == {"cup & saucer": 1, "slips": 2}
    browser = Client()
    browser.force_login(ann)
    page = browser.get("/replay/", {"tag": "cup & saucer"}).content.decode()
    assert page.count("data-episode=") == 1
    assert 'href="/replay/?tag=cup%20%26%20saucer"' in page
    assert "allowed: cup &amp; saucer, slips" in browser.get("/replay/", {"tag": "nope"}).content.decode()
    answer = browser.get("/replay/", {"format": "csv", "tag": "cup & saucer"})
    assert "cup & saucer, slips" in b"".join(answer.streaming_content).decode()
    found = {
        group.name: group.items for group in find(query="slip", user=ann, sight=visibility_for_user(ann))
    }
    assert [(one.title, one.detail, one.address) for one in found["Tags"]] == [
        ("slips", "2 episodes", "/replay/?tag=slips")
    ]


def test_a_tag_that_names_a_hidden_checkpoint_is_no_tag_for_whom_it_is_hidden_from(closed, ann):
    episode = closed()
    tags_change(user=ann, episode=episode, add=["secret-birch slips", "secret-birches", "cup"])
    row = episode_get(uuid=episode.uuid)
    assert BLIND.tags_of(row) == ["cup", "secret-birches"]
    assert list(tag_counts(sight=BLIND)) == ["cup", "secret-birches"]
    assert [found.name for found in find(query="secret-birch slips", user=ann, sight=BLIND)] == []
    assert episode_list(tag="cup").count() == 1
