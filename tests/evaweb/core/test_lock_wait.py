import threading

import pytest
from django.db import connection, connections

from evaweb.core.lock_wait import limit_page_waits, lock_wait, short_lock_wait

pytestmark = pytest.mark.django_db


def fails(within):
    within.append(patience())
    raise ZeroDivisionError


def patience():
    with connection.cursor() as cursor:
        name = "PRAGMA busy_timeout" if connection.vendor == "sqlite" else "SHOW lock_timeout"
        cursor.execute(name)
        return cursor.fetchone()[0]


def test_a_locked_database_is_waited_for_as_long_as_is_said_and_then_as_usual():
    within = []
    with pytest.raises(ZeroDivisionError), lock_wait(0.25):
        fails(within)
    usual = ([250], 20_000) if connection.vendor == "sqlite" else (["250ms"], "0")
    assert (within, patience()) == usual


def test_what_is_done_within_it_is_done():
    with lock_wait(0), connection.cursor() as cursor:
        cursor.execute("SELECT 1")
        assert cursor.fetchone() == (1,)


def test_a_connection_that_is_opened_in_a_hurry_stays_so():
    """Each request has a thread, and with it a connection, of its own."""
    found = []

    def request():
        try:
            with short_lock_wait(1.5):
                found.append(patience())
                with lock_wait(0.25):
                    found.append(patience())
                found.append(patience())
        finally:
            connection.close()

    thread = threading.Thread(target=request)
    thread.start()
    thread.join()
    sqlite = connection.vendor == "sqlite"
    assert found == ([1500, 250, 1500] if sqlite else ["1500ms", "250ms", "1500ms"])


def test_pages_do_not_wait_long_for_a_server_and_other_processes_do(monkeypatch):
    options = {"connect_timeout": 10}
    monkeypatch.setitem(connections.settings, "default", {"OPTIONS": options})
    limit_page_waits()
    assert options == {"connect_timeout": 2}
