"""Connections that have sent no whole request: the newest always get in."""

from __future__ import annotations

import pytest

from evaweb.console.connection_limits import ConnectionLimiter


@pytest.fixture
def now():
    return [0.0]


@pytest.fixture
def closed():
    return []


@pytest.fixture
def arrive(now, closed):
    made = ConnectionLimiter(most=6, most_of_one=3, clock=lambda: now[0])

    def came(key, peer="10.0.0.1", seconds=15.0):
        made.add(key, peer, seconds, lambda: closed.append(key))

    came.all_of_them = made
    return came


def test_behind_one_address_the_oldest_makes_place(arrive, closed):
    for key in range(5):
        arrive(key)
    assert closed == [0, 1]


def test_an_address_that_floods_costs_no_other_its_place(arrive, closed):
    arrive(100, "10.0.0.2")
    for key in range(50):
        arrive(key)
    assert 100 not in closed
    assert len(arrive.all_of_them) == 4


def test_of_all_together_the_oldest_makes_place(arrive, closed):
    for key in range(8):
        arrive(key, f"10.0.0.{key}")
    assert closed == [0, 1]


def test_one_that_sent_its_request_is_closed_for_nobody(arrive, closed, now):
    arrive(0)
    arrive.all_of_them.remove(0)
    for key in range(1, 10):
        arrive(key)
    now[0] = 100.0
    arrive.all_of_them.close_expired()
    assert sorted(closed) == list(range(1, 10))
    assert len(arrive.all_of_them) == 0
    assert arrive.all_of_them._of == {}


def test_each_has_its_time(arrive, closed, now):
    arrive(0, seconds=15.0)
    arrive(1, seconds=75.0)
    now[0] = 20.0
    arrive.all_of_them.close_expired()
    assert closed == [0]
    arrive(1, seconds=75.0)  # answered: its time begins anew
    now[0] = 80.0
    arrive.all_of_them.close_expired()
    assert closed == [0]
