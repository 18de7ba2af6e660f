import pytest
from django.db import connection

from evaweb.lock_wait import lock_wait

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
