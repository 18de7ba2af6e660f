"""A disk that is full, a database that takes nothing: a sentence with 507 or 503, on pages as over REST."""

import errno
import json
from contextlib import suppress

import pytest
from django.conf import settings
from django.db import OperationalError, connection
from django.test import Client

from evaweb.core.storage_errors import storage_error_response
from tests.evaweb.trials import builders

pytestmark = pytest.mark.django_db(transaction=True)


@pytest.fixture
def ann(db):
    return builders.user("ann")


@pytest.fixture
def full(db):
    """A database that cannot grow."""
    with connection.cursor() as cursor:
        if connection.vendor != "sqlite":
            pytest.skip("only SQLite can be told how large it may become")
        cursor.execute("PRAGMA page_count")
        pages = cursor.fetchone()[0]
        cursor.execute(f"PRAGMA max_page_count = {pages + 1}")
        for size in (3000, 1000, 300, 100, 30, 10, 1):
            with suppress(OperationalError):
                for number in range(10_000):
                    row = [f"{size}-{number}", "x" * size, "2030-01-01"]
                    cursor.execute("INSERT INTO django_session VALUES (%s, %s, %s)", row)
        yield
        cursor.execute("PRAGMA max_page_count = 1073741823")


@pytest.fixture
def read_only(db):
    with connection.cursor() as cursor:
        if connection.vendor != "sqlite":
            pytest.skip("SQLite's own switch")
        cursor.execute("PRAGMA query_only = ON")
        yield
        cursor.execute("PRAGMA query_only = OFF")


def login(accept="text/html"):
    client = Client(raise_request_exception=False, headers={"accept": accept})
    return client.post("/login/", {"username": "ann", "password": "ann"})


def test_a_login_on_a_full_disk_says_so(ann, full):
    answer = login()
    assert answer.status_code == 507
    assert "the disk of the lab is full" in answer.content.decode()
    assert settings.SESSION_COOKIE_NAME not in answer.cookies
    assert login("*/*").json()["error"].startswith("the disk of the lab is full")


def test_a_login_at_a_database_that_is_read_only_says_so(ann, read_only):
    answer = login()
    assert answer.status_code == 503
    assert "cannot be written" in answer.content.decode()


def test_a_station_is_shown_though_nobody_can_note_where_somebody_is(ann, client, live, read_only):
    with connection.cursor() as cursor:
        cursor.execute("PRAGMA query_only = OFF")
        client.force_login(ann)
        cursor.execute("PRAGMA query_only = ON")
    page = client.get(f"/stations/{live.name}/debug/")
    assert page.status_code == 200
    assert 'id="estop"' in page.content.decode()


def test_rest_says_so(bench, client, request):
    client.force_login(bench.operator)
    request.getfixturevalue("read_only")
    trial = {"scene": bench.scene.name, "position": 1, "checkpoint": bench.checkpoint.name, "seed": 7}
    address = f"/api/v1/stations/{bench.station.name}/trials"
    answer = client.post(address, json.dumps(trial), content_type="application/json")
    assert answer.status_code == 503
    assert set(answer.json()) == {"error", "id", "arguments"}


@pytest.mark.parametrize(
    ("fault", "status"),
    [
        (OperationalError("database or disk is full"), 507),
        (OperationalError('could not extend file "base/1": No space left on device'), 507),
        (OSError(errno.ENOSPC, "No space left on device"), 507),
        (OperationalError("attempt to write a readonly database"), 503),
        (OSError(errno.EROFS, "Read-only file system"), 503),
        (OperationalError("database is locked"), 503),
        (OSError(errno.ENOENT, "No such file"), None),
        (ValueError("disk is full"), None),
        (None, None),
    ],
)
def test_only_what_the_storage_refuses_is_told_as_that(fault, status):
    found = storage_error_response(fault)
    assert (found and found[1]) == status
