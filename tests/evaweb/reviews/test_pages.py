"""What pages show of quality and reviews; what Replay's module makes of flags and segments."""

import json
import shutil
import subprocess
from pathlib import Path

import pytest
from django.urls import reverse
from hypothesis import given, settings
from hypothesis import strategies as st

from evaweb.jobs.services import run_queue
from evaweb.reviews import services
from evaweb.reviews.models import Standing
from tests.examples import some

NODE = shutil.which("node")
LANES = Path(__file__).parents[3] / "static" / "replay" / "review_lanes.js"
needs_node = pytest.mark.skipif(NODE is None, reason="Node is not installed: the page's modules are not run")


@pytest.fixture
def browser(client, ann):
    client.force_login(ann)
    return client


@pytest.fixture
def two(closed):
    """A flagged episode and one that is not checked."""
    flagged, waiting = closed("finished"), closed("interrupted")
    Standing.objects.create(
        episode=flagged,
        checked_at=flagged.created_at,
        asked_at=flagged.created_at,
        clean=False,
        worst="error",
        flags=3,
    )
    return flagged, waiting


def listed(browser, **query):
    page = browser.get(reverse("replay-list"), query).content.decode()
    return {part.split('"')[0] for part in page.split('data-episode="')[1:]}, page


@pytest.mark.django_db
def test_the_list_says_what_was_found_and_said(browser, two, ann):
    _, waiting = two
    services.add_review(user=ann, episode=waiting, verdict="pass")
    _, page = listed(browser)
    assert 'data-quality="error">3 flags<' in page
    assert "not checked" in page
    assert 'data-verdict="pass">pass<' in page
    assert "unreviewed" in page


@pytest.mark.django_db
def test_the_list_is_narrowed_to_what_is_flagged_or_waits(browser, two, ann):
    flagged, waiting = (str(episode.uuid) for episode in two)
    assert listed(browser, quality="flagged")[0] == {flagged}
    assert listed(browser, quality="clean")[0] == set()
    assert listed(browser, quality="unchecked")[0] == {waiting}
    assert listed(browser, review="unreviewed")[0] == {flagged, waiting}
    services.add_review(user=ann, episode=two[0], verdict="fail")
    assert listed(browser, review="unreviewed")[0] == {waiting}
    assert listed(browser, review="fail")[0] == {flagged}
    assert listed(browser, review="pass")[0] == set()
    assert "Review: passed" in listed(browser, review="pass")[1]
    assert (
        "review = &#x27;maybe&#x27;; allowed: unreviewed, pass, fail. All are shown"
        in listed(browser, review="maybe")[1]
    )


@pytest.mark.django_db
def test_the_page_of_an_episode_has_its_review_where_it_can_be_played(browser, closed):
    episode = closed()
    address = reverse("replay", args=[episode.uuid])
    assert 'id="review"' not in browser.get(address).content.decode()
    run_queue("cpu")
    page = browser.get(address).content.decode()
    assert f'data-address="/api/v1/episodes/{episode.uuid}/reviews"' in page
    assert f'data-next="/api/v1/reviews/next?after={episode.uuid}"' in page


def run(body, given):
    """What `body` returns, where `m` is the module and `given` the argument."""
    script = (
        f"const m = await import({json.dumps(LANES.as_uri())});"
        "const given = JSON.parse((await import('node:fs')).readFileSync(0, 'utf8'));"
        f"console.log(JSON.stringify((() => {{ {body} }})()));"
    )
    found = subprocess.run(
        [NODE, "--input-type=module", "-e", script],
        input=json.dumps(given),
        capture_output=True,
        text=True,
        check=False,
    )
    assert found.returncode == 0, found.stderr
    return json.loads(found.stdout)


SPANS = st.lists(
    st.tuples(st.integers(0, 50), st.integers(0, 20)).map(lambda one: (one[0], sum(one))), max_size=12
)


@needs_node
@settings(max_examples=some(15))
@given(SPANS)
def test_segments_that_overlap_lie_below_each_other(spans):
    segments = [{"first": first, "last": last} for first, last in sorted(spans)]
    lanes = run("return m.stackLanes(given);", segments)
    for number, one in enumerate(lanes):
        for other in lanes[:number]:
            apart = other["last"] < one["first"] or one["last"] < other["first"]
            assert apart or one["lane"] != other["lane"]


@needs_node
@settings(max_examples=some(15))
@given(SPANS)
def test_where_segments_overlap_is_said_with_how_many(spans):
    segments = [{"first": first, "last": last} for first, last in spans]
    found = run("return m.overlaps(given);", segments)
    told = {row: one["count"] for one in found for row in range(one["first"], one["last"] + 1)}
    counted = {row: sum(first <= row <= last for first, last in spans) for row in range(80)}
    assert told == {row: count for row, count in counted.items() if count > 1}


@needs_node
def test_flags_are_walked_through_and_the_worst_of_a_row_comes_first():
    flags = [
        {"first": -1, "last": -1, "severity": "error"},
        {"first": 5, "last": 9, "severity": "warning"},
        {"first": 8, "last": 8, "severity": "error"},
    ]
    found = run(
        "return [m.nextFlag(given, 0, 1), m.nextFlag(given, 5, 1), m.nextFlag(given, 8, 1), m.nextFlag(given, 8, -1),"
        " m.nextFlag(given, 5, -1), m.flagsAt(given, 8).map((one) => one.severity), m.flagsAt(given, 4)];",
        flags,
    )
    assert found == [5, 8, None, 5, None, ["error", "warning"], []]
