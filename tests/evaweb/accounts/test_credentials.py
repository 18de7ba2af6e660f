"""Who is remembered, and for what the database is waited for."""

from __future__ import annotations

import asyncio
import threading
from unittest import mock

import pytest
from django.db import OperationalError
from django.test import Client
from hypothesis import given
from hypothesis import strategies as st

from evaweb.accounts import credentials as module
from evaweb.accounts.credentials import (
    COUNTS_S,
    SESSION,
    TOKEN,
    CredentialCache,
    LookupOverload,
    Unverifiable,
    credentials,
    session_user,
)
from evaweb.accounts.lookup_pool import FairLookupPool
from evaweb.accounts.roles import Role
from evaweb.api.models import Token
from evaweb.api.tokens import create_token
from tests.processes import PATIENCE_S


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
    """A database under the test's hand, and what it was asked.

    Where it hangs time passes, and `meanwhile` is what happens then; else who waits has an answer.
    """

    def __init__(self, now):
        self.questions, self.fault, self.users = [], None, {"a": Person("ann")}
        self.answers = threading.Event()
        self.answers.set()
        self._now, self.heard, self.meanwhile = now, lambda: None, lambda: None

    @property
    def asked(self):
        return len(self.questions)

    def __call__(self, secret):
        self.questions.append(secret)
        assert self.answers.wait(PATIENCE_S)
        if self.fault:
            raise self.fault
        self.heard()
        return self.users.get(secret)

    async def waited_for(self, answers, timeout):
        assert timeout > 0
        if self.answers.is_set():
            await asyncio.wait(answers)
        else:
            self._now[0] += timeout
            await asyncio.sleep(0)
            self.meanwhile()


@pytest.fixture
def base(now):
    made = Base(now)
    yield made
    made.answers.set()


@pytest.fixture
def now():
    return [100.0]


@pytest.fixture
def known(base, now, monkeypatch):
    monkeypatch.setattr(module.connection, "close", lambda: None)
    made = CredentialCache(clock=lambda: now[0], wait=base.waited_for)
    made.register_kind("key", base)
    base.heard = made.record_answer
    return made


HERE = "192.0.2.1"
KEY = [("key", "a")]


def run(wanted):
    return asyncio.run(wanted)


def presses(known, secret="a"):
    return run(known.resolve_presser([("key", secret)], HERE))


def stops(known, secret="a"):
    found = run(known.resolve_stopper([("key", secret)], HERE))
    return found and found[1]


def test_who_is_remembered_presses_at_once_whatever_the_database_does(known, base, now):
    known.look_up("key", "a")
    base.answers.clear()
    now[0] += 10**6
    login = presses(known)
    assert (login.username, login.role, now[0]) == ("ann", Role.OPERATOR, 100.0 + 10**6)


@pytest.mark.parametrize("ask", [presses, stops])
def test_a_database_that_is_away_verifies_nobody_new(known, base, ask):
    base.fault = OperationalError("gone")
    with pytest.raises(Unverifiable, match="the database does not answer: gone"):
        ask(known)


@pytest.mark.parametrize("ask", [presses, stops])
def test_a_database_that_hangs_is_waited_for_half_a_second(known, base, now, ask):
    base.answers.clear()
    with pytest.raises(Unverifiable, match=r"did not answer within 0\.5 s"):
        ask(known)
    assert now[0] == 100.5


@pytest.mark.parametrize("ask", [presses, stops])
def test_a_database_that_answers_others_is_waited_for_longer_and_who_has_no_turn_is_told_so(
    known, base, now, ask
):
    base.answers.clear()
    base.meanwhile = known.record_answer
    with pytest.raises(LookupOverload, match="not served within 1 s"):
        ask(known)
    assert now[0] == pytest.approx(101.0)


def test_a_database_that_falls_silent_meanwhile_is_not_taken_for_a_busy_one(known, base, now):
    base.answers.clear()
    base.meanwhile = lambda: known.record_answer() if now[0] < 101.0 else None
    with pytest.raises(Unverifiable):
        presses(known)
    assert now[0] == pytest.approx(101.0)


def test_what_is_nobodys_is_not_asked_again_for_some_seconds(known, base, now):
    assert (presses(known, "x"), stops(known, "x"), base.asked) == (None, None, 1)
    base.answers.clear()
    assert presses(known, "x") is None, "also where the database has gone since"
    base.answers.set()
    now[0] += 5.0
    base.users["x"] = Person("bob")
    assert presses(known, "x").username == "bob"
    assert base.asked == 2


def test_what_was_nobodys_is_somebodys_as_soon_as_this_process_hears_of_it(known, base):
    presses(known, "x")
    known.remember("key", "x", Person("bob"))
    assert presses(known, "x").username == "bob"


def test_so_many_are_known_to_be_nobodys(known, base, monkeypatch):
    monkeypatch.setattr(module, "_MOST", 2)
    for name in ("x", "y", "z", "z", "y", "x"):
        presses(known, name)
    assert base.questions == ["x", "y", "z", "x"]


def test_a_stop_goes_by_what_was_known_where_the_database_hangs_and_by_the_database_where_it_answers(
    known, base, now
):
    known.look_up("key", "a")
    base.answers.clear()
    now[0] += 60
    assert stops(known).role is Role.OPERATOR
    assert now[0] == 160.25
    base.users.clear()
    base.answers.set()
    assert stops(known) is None, "a withdrawn one counts at once"
    assert known.recall("key", "a") is None
    assert presses(known) is None


def test_for_what_is_no_stop_a_login_counts_for_a_minute_after_the_database_said_whose_it_is(
    known, base, now
):
    assert known.recall_recent("key", "a") is None
    known.look_up("key", "a")
    base.fault = OperationalError("gone")
    now[0] += COUNTS_S - 0.1
    assert known.recall_recent("key", "a").username == "ann"
    now[0] += 0.2
    assert known.recall_recent("key", "a") is None
    assert stops(known).username == "ann", "a stop counts for longer"
    base.fault = None
    known.look_up("key", "a")
    assert known.recall_recent("key", "a").username == "ann"
    assert base.asked == 3


def test_what_was_just_verified_is_not_asked_again(known, base):
    known.look_up("key", "a")
    stops(known)
    presses(known)
    assert base.asked == 1


@pytest.fixture
def patient(known, monkeypatch):
    """Who waits is no matter of seconds."""
    monkeypatch.setattr(known, "_wait", asyncio.wait)
    monkeypatch.setattr(module, "_PATIENCE_S", 600.0)
    monkeypatch.setattr(module, "_TURN_S", 600.0)


@pytest.mark.usefixtures("patient")
def test_a_flood_of_one_credential_asks_once(known, base):
    async def flood():
        waiting = [asyncio.create_task(known.resolve_presser(KEY, HERE)) for _ in range(500)]
        await asyncio.sleep(0)
        base.answers.set()
        return await asyncio.gather(*waiting)

    base.answers.clear()
    assert {login.username for login in run(flood())} == {"ann"}
    assert base.asked == 1


def test_of_several_credentials_one_that_is_remembered_presses_and_stops_at_once(known, base, now):
    known.look_up("key", "a")
    base.answers.clear()
    found = [("key", "x"), ("key", "y"), ("key", "a")]
    assert run(known.resolve_presser(found, HERE)).username == "ann"
    kind, login = run(known.resolve_stopper(found, HERE))
    assert (kind, login.username, now[0], base.asked) == ("key", "ann", 100.0, 1)


@pytest.mark.usefixtures("patient")
def test_of_several_credentials_any_is_good_and_who_is_found_waits_for_no_other(known, base):
    hangs = threading.Event()
    known.register_kind("slow", lambda secret: hangs.wait(PATIENCE_S) and None)
    found = [("slow", "x"), ("key", "y"), ("key", "a")]
    assert run(known.resolve_presser(found, HERE)).username == "ann"
    hangs.set()
    assert run(known.resolve_stopper(found, HERE))[1].username == "ann"
    assert run(known.resolve_presser(found[:2], HERE)) is None
    base.fault = OperationalError("gone")
    with pytest.raises(Unverifiable):
        run(known.resolve_presser([("slow", "z"), ("key", "new")], HERE))


@pytest.mark.parametrize("kind", [SESSION, TOKEN])
def test_who_presses_is_one_question_whatever_the_date_and_a_stop_goes_by_the_date(known, base, kind):
    known.register_kind(kind, lambda secret: None)
    known.register_kind(f"{kind} of any age", base)
    assert run(known.resolve_presser([(kind, "a")], HERE)).username == "ann"
    assert run(known.resolve_stopper([(kind, "a")], HERE)) is None
    assert run(known.resolve_presser([(kind, "a")], HERE)).username == "ann"
    assert base.asked == 1


@pytest.mark.parametrize("ask", ["resolve_presser", "resolve_stopper", "look"])
def test_who_is_remembered_when_their_time_is_over_presses_at_once_all_the_same(known, base, now, ask):
    ends = {"a": Person("ann")}
    known.register_kind(SESSION, ends.get)
    known.register_kind("session of any age", base)
    known.look_up(SESSION, "a")
    ends.clear()
    now[0] += 60.0
    found = [(SESSION, "a")]
    if ask == "look":
        known.look_up(SESSION, "a")
    else:
        run(getattr(known, ask)(found, HERE))
    known._check(SESSION, "a").result(PATIENCE_S)
    base.answers.clear()
    assert run(known.resolve_presser(found, HERE)).username == "ann"
    assert (known.recall(SESSION, "a"), now[0]) == (None, 160.0)


def test_without_another_thread_a_press_is_not_lost(known, base, now, monkeypatch):
    def none(work):
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(known._strangers._threads, "submit", none)
    base.answers.clear()
    with pytest.raises(Unverifiable):
        presses(known)
    assert now[0] == 100.5


@given(
    crowd=st.lists(st.tuples(st.sampled_from("ABC"), st.integers(0, 30)), max_size=80),
    remembered=st.lists(st.integers(0, 5), min_size=1, max_size=6),
)
def test_nobody_who_is_remembered_waits_behind_anybody_who_is_not(crowd, remembered):
    now, closed = [100.0], threading.Event()
    known = CredentialCache(clock=lambda: now[0])
    users = {f"known {number}": Person("ann") for number in range(6)}
    known.register_kind("key", lambda secret: users.get(secret) or (closed.wait(PATIENCE_S) and None))
    with mock.patch.object(module.connection, "close"):
        for secret in users:
            known.look_up("key", secret)
        now[0] += 60.0
        for share, number in crowd:
            known._check("key", f"made up {number}", share)
        for number in remembered:
            fresh = known._check("key", f"known {number}").result(PATIENCE_S)
            assert (fresh.username, fresh.checked) == ("ann", now[0])
        asked = list(known._asked.values())
        closed.set()
        assert all(answer.result(PATIENCE_S) is None for answer in asked)


@pytest.mark.usefixtures("patient")
def test_a_crowd_waits_behind_itself_and_is_turned_away_where_there_is_no_room(known, base):
    crowd, more = "203.0.113.9", "198.51.100.4"
    known._strangers = FairLookupPool(1, most=4)

    async def pressed():
        base.answers.clear()
        asked = [asyncio.create_task(known.resolve_presser([("key", f"x{n}")], crowd)) for n in range(5)]
        while base.asked == 0:  # the first has its turn, four wait
            await asyncio.sleep(0)
        refused = asyncio.create_task(known.resolve_presser([("key", "x5")], crowd))
        ann = asyncio.create_task(known.resolve_presser(KEY, more))
        await asyncio.sleep(0)
        base.answers.set()
        return await asyncio.gather(*asked, refused, ann, return_exceptions=True)

    *asked, refused, ann = run(pressed())
    assert ann.username == "ann"
    assert isinstance(refused, LookupOverload)
    assert "too many logins from this address" in str(refused)
    assert [isinstance(one, LookupOverload) for one in asked] == [False] * 4 + [True], "the newest gives way"
    assert base.questions.index("a") == 2


def test_so_many_are_remembered(known, base, monkeypatch):
    monkeypatch.setattr(module, "_MOST", 2)
    base.users = {name: Person(name) for name in "abc"}
    for name in "abc":
        known.look_up("key", name)
    assert [known.recall("key", name) is not None for name in "abc"] == [False, True, True]


@pytest.mark.django_db
def test_a_session_that_is_logged_out_and_a_token_that_is_withdrawn_are_forgotten(ann):
    client = Client()
    client.force_login(ann)
    key, token = client.session.session_key, create_token(user=ann, name="x")
    for kind, secret in ((SESSION, key), (TOKEN, token)):
        assert credentials.look_up(kind, secret) == ann
        assert credentials.recall(kind, secret).username == "ann"
    client.post("/logout/")
    Token.objects.get().delete()
    assert credentials.recall(SESSION, key) is None
    assert credentials.recall(TOKEN, token) is None
    assert session_user(key) is None


@pytest.mark.parametrize("key", ["\x00" * 32, "a b", "'; --", "é" * 32])
def test_what_cannot_be_a_session_is_nobodys_without_asking(key):
    assert session_user(key) is None
