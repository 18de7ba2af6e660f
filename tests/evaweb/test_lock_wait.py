import pytest
from django.db import connection

from evaweb.lock_wait import lock_wait

pytestmark = pytest.mark.django_db


def fails(within):
    within.append(patience())
    raise ZeroDivisionError


def patience():
    with connection.cursor() as cursor:
        return cursor.execute("PRAGMA busy_timeout").fetchone()[0]


@pytest.mark.skipif(connection.vendor != "sqlite", reason="others lock rows")
def test_a_locked_database_is_waited_for_as_long_as_is_said_and_then_as_usual():
    within = []
    with pytest.raises(ZeroDivisionError), lock_wait(0.25):
        fails(within)
    assert (within, patience()) == ([250], 20_000)


def test_what_is_done_within_it_is_done():
    with lock_wait(0), connection.cursor() as cursor:
        cursor.execute("SELECT 1")
        assert cursor.fetchone() == (1,)
