"""Times on pages are the lab's, and say so."""

from datetime import UTC, date, datetime

import pytest
from django.template import engines
from django.utils import timezone

MOMENT = datetime(2026, 7, 1, 23, 30, 5, tzinfo=UTC)


@pytest.fixture
def berlin(settings):
    settings.TIME_ZONE = "Europe/Berlin"
    timezone.get_default_timezone.cache_clear()
    yield
    timezone.get_default_timezone.cache_clear()


def shown(text, **context):
    return engines["django"].from_string(text).render(context)


@pytest.mark.usefixtures("berlin")
def test_a_time_is_that_of_the_lab_and_names_its_zone():
    assert shown("{% when at %}", at=MOMENT) == (
        '<time datetime="2026-07-02T01:30:05+02:00" title="2026-07-02 01:30:05 Europe/Berlin (UTC+02:00)">'
        "2026-07-02 01:30</time>"
    )
    assert "Europe/Berlin (UTC+0" in shown("{% lab_zone %}")


def test_utc_is_said_once():
    assert shown('{% when at "H:i" %}', at=MOMENT) == (
        '<time datetime="2026-07-01T23:30:05+00:00" title="2026-07-01 23:30:05 UTC">23:30</time>'
    )
    assert shown("{% lab_zone %}") == "UTC"


def test_a_day_has_no_zone_and_nothing_is_said_as_asked():
    assert (
        shown('{% when at "Y-m-d" %}', at=date(2026, 7, 1)) == '<time datetime="2026-07-01">2026-07-01</time>'
    )
    assert shown('{% when at %}|{% when at "H:i" "now" %}', at=None) == "–|now"
