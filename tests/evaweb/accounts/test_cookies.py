"""Several cookies of one name, of which one is good."""

from __future__ import annotations

from datetime import timedelta
from email.utils import parsedate_to_datetime

import pytest
from django.conf import settings
from django.contrib.auth.models import User
from django.contrib.sessions.models import Session
from django.test import Client
from django.utils import timezone

from evaweb.accounts.cookies import cookie_values, session_keys
from evaweb.accounts.credentials import (
    EXPIRED_ALLOWED,
    SESSION,
    credentials,
    digest,
)

NAME = settings.SESSION_COOKIE_NAME


@pytest.mark.parametrize(
    ("headers", "found"),
    [
        ([], []),
        (["a=1"], ["1"]),
        (["a=1; a=2; b=3; a=1"], ["1", "2"]),
        (["a=1; b", "c; a=2;a="], ["1", "2"]),
        ([" a = 1 ; A=2; aa=3; =a"], ["1"]),
        ([f"a={number}" for number in range(100)], [str(number) for number in range(100)]),
    ],
)
def test_all_that_cookies_of_a_name_say_is_found_in_order(headers, found):
    assert cookie_values(headers, "a") == found


@pytest.mark.parametrize("kind", [SESSION, EXPIRED_ALLOWED[SESSION]])
def test_eight_sessions_are_asked_about_and_one_that_is_remembered_is_among_them(kind):
    account = User(pk=1, username="ann", is_superuser=True)
    made_up = [f"{NAME}=of-{number}" for number in range(99)]
    assert session_keys(made_up) == [f"of-{number}" for number in range(8)]
    credentials.remember(kind, "good", account)
    try:
        assert session_keys([*made_up, f"{NAME}=good"]) == ["good", *(f"of-{number}" for number in range(7))]
    finally:
        credentials.forget(kind, digest("good"))


def test_this_labs_cookies_are_named_as_no_other_labs():
    names = {settings.SESSION_COOKIE_NAME, settings.CSRF_COOKIE_NAME}
    assert len({name.removeprefix("eva_session_").removeprefix("eva_csrf_") for name in names}) == 1
    assert not names & {"sessionid", "csrftoken"}


@pytest.mark.parametrize("order", ["{}; {}=of-elsewhere", "{1}=of-elsewhere; {0}"])
def test_a_page_is_shown_to_whose_session_is_any_of_them(ann, order):
    browser = Client()
    browser.force_login(ann)
    mine = f"{NAME}={browser.cookies[NAME].value}"
    said = {"cookie": order.format(mine, NAME)}
    assert Client().get("/api/v1/me", headers=said).json()["username"] == "ann"
    neither = {"cookie": f"{NAME}=of-elsewhere; {NAME}=of-nowhere"}
    assert Client().get("/api/v1/me", headers=neither).status_code == 401


def test_a_login_sets_this_labs_cookies_alone(ann):
    ann.set_password("s")
    ann.save()
    browser = Client()
    assert browser.post("/login/", {"username": "ann", "password": "s"}).status_code == 302
    assert set(browser.cookies) == {settings.SESSION_COOKIE_NAME, settings.CSRF_COOKIE_NAME}


@pytest.fixture
def logged_in(ann):
    """A browser whose cookie is of a login of ann's."""
    ann.set_password("s")
    ann.save()
    browser = Client()
    browser.post("/login/", {"username": "ann", "password": "s"})
    return browser


def test_a_browser_keeps_the_cookie_of_a_session_that_has_ended(logged_in):
    Session.objects.update(expire_date=timezone.now() - timedelta(days=1))
    answers = [logged_in.get("/"), logged_in.get("/api/v1/me"), logged_in.get("/login/")]
    assert [answer.status_code for answer in answers] == [302, 401, 200]
    assert not any(NAME in answer.cookies for answer in answers)


def test_a_logout_has_the_cookie_deleted(logged_in):
    assert logged_in.post("/logout/").cookies[NAME]["max-age"] == 0


def test_a_cookie_outlives_its_session(logged_in):
    cookie, row = logged_in.cookies[NAME], Session.objects.get()
    assert cookie["max-age"] == 365 * 24 * 3600
    assert parsedate_to_datetime(cookie["expires"]) > timezone.now() + timedelta(days=364)
    assert row.expire_date < timezone.now() + timedelta(seconds=settings.SESSION_COOKIE_AGE + 1)
