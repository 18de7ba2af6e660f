"""Who is remembered, and for what the database is waited for."""

from __future__ import annotations

import asyncio
import threading

import pytest
from django.db import OperationalError
from django.test import Client

from evaweb import credentials as module
from evaweb.api.models import Token
from evaweb.api.tokens import token_create
from evaweb.credentials import COUNTS_S, SESSION, TOKEN, Credentials, Unverifiable, credentials, session_user
from evaweb.roles import Role


class Person:
    """A user with a role, and no database."""

    is_superuser = False

    def __init__(self, name, role="operator"):
        self.pk, self._name, self.groups = 7, name, self
        self._roles = [role]

    def get_username(self):
        return self._name

    def values_list(self, *names, flat):
        return self._roles


class Base:
    """A database under the test's hand, and how often it was asked."""

    def __init__(self):
        self.asked, self.fault, self.users = 0, None, {"a": Person("ann")}
        self.answers = threading.Event()
        self.answers.set()

    def __call__(self, secret):
        self.asked += 1
        assert self.answers.wait(20)
        if self.fault:
            raise self.fault
        return self.users.get(secret)


@pytest.fixture
def base():
    return Base()


@pytest.fixture
def now():
    return [100.0]


@pytest.fixture
def known(base, now, monkeypatch):
    monkeypatch.setattr(module.connection, "close", lambda: None)
    made = Credentials(clock=lambda: now[0])
    made.learn("key", base)
    return made


def run(wanted):
    return asyncio.run(wanted)


def test_who_is_remembered_presses_at_once_whatever_the_database_does(known, base, now):
    known.look("key", "a")
    base.answers.clear()
    now[0] += 10**6
    login = run(known.presser("key", "a"))
    base.answers.set()
    assert (login.username, login.role) == ("ann", Role.OPERATOR)


@pytest.mark.parametrize("ask", ["presser", "stopper"])
def test_a_database_that_is_away_verifies_nobody_new(known, base, ask):
    base.fault = OperationalError("gone")
    with pytest.raises(Unverifiable, match="the database does not answer: gone"):
        run(getattr(known, ask)("key", "a"))


@pytest.mark.parametrize("ask", ["presser", "stopper"])
def test_a_database_that_hangs_is_not_waited_for(known, base, ask, monkeypatch):
    monkeypatch.setattr(module, "_PATIENCE_S", 0.01)
    base.answers.clear()
    with pytest.raises(Unverifiable, match="did not answer within"):
        run(getattr(known, ask)("key", "a"))
    base.answers.set()


def test_a_stop_goes_by_what_was_known_where_the_database_hangs_and_by_the_database_where_it_answers(
    known, base, now, monkeypatch
):
    monkeypatch.setattr(module, "_RECHECK_S", 0.01)
    known.look("key", "a")
    base.answers.clear()
    now[0] += 60
    assert run(known.stopper("key", "a")).role is Role.OPERATOR
    base.answers.set()
    monkeypatch.setattr(module, "_RECHECK_S", 20.0)
    base.users.clear()
    assert run(known.stopper("key", "a")) is None, "a withdrawn one counts at once"
    assert known.recall("key", "a") is None
    assert run(known.presser("key", "a")) is None


def test_for_what_is_no_stop_a_login_counts_for_a_minute_after_the_database_said_whose_it_is(
    known, base, now
):
    assert known.counted("key", "a") is None
    known.look("key", "a")
    base.fault = OperationalError("gone")
    now[0] += COUNTS_S - 0.1
    assert known.counted("key", "a").username == "ann"
    now[0] += 0.2
    assert known.counted("key", "a") is None
    assert run(known.stopper("key", "a")).username == "ann", "a stop counts for longer"
    base.fault = None
    known.look("key", "a")
    assert known.counted("key", "a").username == "ann"
    assert base.asked == 3


def test_what_was_just_verified_is_not_asked_again(known, base):
    known.look("key", "a")
    run(known.stopper("key", "a"))
    run(known.presser("key", "a"))
    assert base.asked == 1


def test_a_flood_of_one_credential_asks_once(known, base):
    async def flood():
        base.answers.clear()
        waiting = [asyncio.create_task(known.presser("key", "a")) for _ in range(500)]
        await asyncio.sleep(0)
        base.answers.set()
        return await asyncio.gather(*waiting)

    assert {login.username for login in run(flood())} == {"ann"}
    assert base.asked == 1


def test_a_flood_of_made_up_ones_is_no_longer_queued(known, base, monkeypatch):
    monkeypatch.setattr(module, "_PATIENCE_S", 0.01)
    monkeypatch.setattr(module, "_MOST_ASKED", 3)

    async def flood():
        waiting = [known.presser("key", str(number)) for number in range(20)]
        return await asyncio.gather(*waiting, return_exceptions=True)

    base.answers.clear()
    found = run(flood())
    base.answers.set()
    assert all(isinstance(fault, Unverifiable) for fault in found)
    assert sum("too many logins" in str(fault) for fault in found) == 17


def test_so_many_are_remembered(known, base, monkeypatch):
    monkeypatch.setattr(module, "_MOST", 2)
    base.users = {name: Person(name) for name in "abc"}
    for name in "abc":
        known.look("key", name)
    assert [known.recall("key", name) is not None for name in "abc"] == [False, True, True]


@pytest.mark.django_db
def test_a_session_that_is_logged_out_and_a_token_that_is_withdrawn_are_forgotten(ann):
    client = Client()
    client.force_login(ann)
    key, token = client.session.session_key, token_create(user=ann, name="x")
    for kind, secret in ((SESSION, key), (TOKEN, token)):
        assert credentials.look(kind, secret) == ann
        assert credentials.recall(kind, secret).username == "ann"
    client.post("/logout/")
    Token.objects.get().delete()
    assert credentials.recall(SESSION, key) is None
    assert credentials.recall(TOKEN, token) is None
    assert session_user(key) is None


@pytest.mark.parametrize("key", ["\x00" * 32, "a b", "'; --", "é" * 32])
def test_what_cannot_be_a_session_is_nobodys_without_asking(key):
    assert session_user(key) is None
