"""The last week of each station: what was recorded, without what is blind."""

from datetime import timedelta

import pytest
from django.db import connection
from django.test import Client
from django.test.utils import CaptureQueriesContext
from django.utils import timezone

from evaweb.blinding.visibility import FULL_VISIBILITY, Visibility
from evaweb.console.history import DAYS, histories
from evaweb.episodes.models import Episode
from tests.evaweb.trials import builders

HIDDEN = Visibility(checkpoints=frozenset({1}), names=frozenset({"pi0-secret"}))


@pytest.fixture
def bench(db):
    return builders.bench()


def recorded(bench, days_ago=0, status="finished", **facts):
    began = timezone.now() - timedelta(days=days_ago)
    plain = {"frames": 9, "duration_s": 60.0, "control": {"ticks": 1000, "missed": 2}}
    policy = {"latency_ms": {"p50": 80.0}}
    return Episode.objects.create(
        **{
            "station": bench.station,
            "status": status,
            "started_at": began,
            "policy": policy,
            **plain,
            **facts,
        }
    )


def test_each_day_has_what_was_recorded_in_it(bench):
    recorded(bench)
    recorded(bench, policy={"latency_ms": {"p50": 120.0}}, duration_s=30.0)
    recorded(bench, 2, "interrupted", policy={}, control={})
    recorded(bench, DAYS + 1)  # too long ago
    recorded(bench, status="recording")
    (found,) = histories(FULL_VISIBILITY)
    today, before = found.days[-1], found.days[-3]
    assert (today.runs, today.broken, today.minutes, today.latency_ms, today.missed_per_mille) == (
        2,
        0,
        1.5,
        100.0,
        2.0,
    )
    assert (before.runs, before.broken, before.latency_ms, before.missed_per_mille) == (1, 1, None, None)
    assert sum(day.runs for day in found.days) == 3
    assert [figure.heading for figure in found.figures][:2] == ["Recordings", "Recorded [min]"]
    assert found.figures[3].words.endswith(f"{today.day:%a} 100")


def test_recordings_of_a_hidden_checkpoint_are_left_out_and_counted(bench):
    recorded(bench, checkpoint="pi0-secret", policy={"latency_ms": {"p50": 999.0}})
    recorded(bench, checkpoint="pi0")
    (found,) = histories(HIDDEN)
    assert (found.covered, found.days[-1].runs, found.days[-1].latency_ms) == (1, 1, 80.0)
    assert not any("999" in figure for figure in found.figures)


def test_its_page_asks_as_much_of_a_large_lab_as_of_a_small_one(bench):
    browser = Client()
    browser.force_login(builders.user("vera", "viewer"))

    def asked():
        with CaptureQueriesContext(connection) as captured:
            text = browser.get("/history/").content.decode()
        assert "Policy’s latency" in text or "Policy&#x27;s latency" in text
        return len(captured)

    recorded(bench)
    few = asked()
    for day in range(6):
        recorded(bench, day)
    assert asked() == few
