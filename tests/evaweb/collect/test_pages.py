"""The Collect page: where its tab is, what stands on it in every state, whoever looks; and how the web learns of it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from django.contrib.auth.models import User
from django.test import Client

from evaweb.collect import services
from evaweb.collect.models import CollectSession, Demonstration
from evaweb.console import change_marks
from evaweb.console.event_ingest import StationEventIngester, ingest_events
from evaweb.console.feed import Feeds, History
from evaweb.jobs.models import Job
from evaweb.reviews.models import Standing
from evaweb.stations.models import Station
from runtime.recording.labels import Label, append_label
from tests.evaweb.collect.conftest import Demonstrate, collecting
from tests.evaweb.stand_in import FakeStation
from tests.evaweb.trials.builders import FakeConnection
from tests.processes import eventually, joined

pytestmark = pytest.mark.django_db
NASTY, ESCAPED = "<script>alert(1)</script>", "&lt;script&gt;alert(1)&lt;/script&gt;"
PAGE, SESSION, PROGRESS = (f"/stations/bench/collect/{part}" for part in ("", "session", "progress"))


@pytest.fixture
def browser(client: Client, ann: User) -> Client:
    client.force_login(ann)
    return client


def text(browser: Client, path: str) -> str:
    answer = browser.get(path)
    assert answer.status_code == 200, answer.content[:500]
    return answer.content.decode()


def test_the_tab_is_there_where_the_station_collects(browser: Client, station: Station) -> None:
    assert ">Collect</a>" not in text(browser, "/stations/bench/debug/")
    Station.objects.update(collects=True)
    assert f'<a href="{PAGE}">Collect</a>' in text(browser, "/stations/bench/debug/")
    assert f'<a href="{PAGE}" aria-current="page">Collect</a>' in text(browser, PAGE)
    assert f'href="{PAGE}">Collect</a>' in text(browser, "/")


def test_without_a_session_it_offers_tasks_and_sessions_of_before(
    browser: Client, session: CollectSession, ann: User
) -> None:
    services.close_session(user=ann, session=session)
    shown = text(browser, PAGE)
    assert '<option value="stack the cups">' in shown
    assert f'<option value="{session.pk}">' in shown
    assert 'name="dataset" type="text" maxlength="100" autocomplete="off" value="cups"' in shown
    assert "data-session-uuid" not in shown
    assert text(browser, PROGRESS).strip() == ""


def test_every_button_of_the_page_has_its_key_and_space_is_the_e_stop_there_too(
    browser: Client, station: Station
) -> None:
    shown = text(browser, PAGE)
    for key in ("a", "enter", "d", "r", "1", "2", "3", "u", "o", "shift+o", "shift+a"):
        assert shown.count(f'data-key="{key}"') == (1 if key != "shift+o" else 0), key
    assert 'data-key="space"' not in shown
    assert "Software stop: <kbd>Esc</kbd> or <kbd>Space</kbd>." in shown


def test_a_session_is_shown_with_counts_queue_flags_and_what_can_be_published(
    browser: Client, session: CollectSession, demonstrate: Demonstrate
) -> None:
    for result in ("success", "fail"):
        demonstrate(result)
    newest = demonstrate("partial")
    Job.objects.all().delete()
    failed = Job.objects.create(
        kind="quality", key=f"quality:{newest.pk}", status="failed", error=f"no {NASTY}"
    )
    Standing.objects.create(
        episode=newest.episode, checked_at=newest.labelled_at, clean=False, worst="warning", flags=2
    )
    shown = text(browser, SESSION)
    assert f'data-session-uuid="{session.pk}"' in shown
    assert 'id="saved">3</span> of 20 saved' in shown
    assert "1 success · 1 partial · 1 fail · 0 discarded" in shown
    assert f'data-session-uuid="{session.pk}"' in text(
        browser, PAGE
    )  # both in one page, with who has the station
    shown = text(browser, PROGRESS)
    assert f'href="/replay/{newest.pk}/"' in shown
    assert "2 flags" in shown
    assert f'data-job="{failed.pk}"' in shown
    assert (NASTY in shown, f"no {ESCAPED}" in shown) == (False, True)
    assert "Publish 2 <kbd>P</kbd>" in shown
    assert "include the 1 failure" in shown
    assert '<option value="v2.1">v2.1</option><option value="v3.0">' in shown


def test_a_task_is_a_text_and_no_markup(
    browser: Client, at: FakeConnection, data: Path, station: Station, ann: User, vera: User
) -> None:
    services.open_session(user=ann, station=station, task=NASTY)
    browser.force_login(vera)
    shown = text(browser, PAGE)
    assert (NASTY in shown, f'data-task="{ESCAPED}"' in shown) == (False, True)


def test_who_watches_is_told_that_something_has_changed(
    session: CollectSession, demonstrate: Demonstrate, ann: User
) -> None:
    before = change_marks.change_marks("bench")
    services.set_session_target(user=ann, session=session, target=3)
    assert change_marks.changed_names(before, after := change_marks.change_marks("bench")) == ["collect"]
    demonstrate("success")
    assert "collect" in change_marks.changed_names(after, change_marks.change_marks("bench"))


def test_a_label_comes_from_the_event_log_into_the_row(demonstrate: Demonstrate, data: Path) -> None:
    made = demonstrate()
    append_label(data, str(made.pk), Label(1.0, "ann", "partial"))
    told = {
        "number": 1,
        "kind": "labelled",
        "text": "partial",
        "time": 1.0,
        "data": {"episode": str(made.pk)},
    }
    ingest_events(station=made.session.station, history=History("b1", (told,)))
    assert Demonstration.objects.get().result == "partial"


@pytest.mark.django_db(transaction=True)
def test_a_station_says_by_itself_that_it_collects_and_that_it_does_no_more(
    runtime: FakeStation, live: Station
) -> None:
    scribe = StationEventIngester(runtime.name, Feeds())
    scribe.start()

    def says(collect: dict[str, Any] | None) -> None:
        runtime.collect = collect
        wanted = collect is not None
        eventually(lambda: Station.objects.get(pk=live.pk).collects is wanted, f"the row says {wanted}")

    try:
        says(json.loads(json.dumps(collecting())))
        says(None)
    finally:
        scribe.end()
        joined(scribe._thread)
