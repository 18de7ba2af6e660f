"""Everybody changes their own password."""

import pytest
from axes.models import AccessAttempt
from django.conf import settings
from django.contrib.auth.models import User

from evaweb.accounts import password_hashing
from tests.evaweb.test_logins import login

pytestmark = pytest.mark.django_db
NEW = "three-words-and-7"


def change(client, user, old, again=NEW):
    user.set_password("the-old-one-2")
    user.save()
    client.force_login(user)
    return client.post("/password/", {"old_password": old, "new_password1": NEW, "new_password2": again})


def test_who_knows_the_old_one_gets_a_new_one_and_stays_logged_in(client, ann):
    assert change(client, ann, "the-old-one-2").status_code == 302
    assert User.objects.get().check_password(NEW)
    assert client.get("/password/").status_code == 200


@pytest.mark.parametrize(("old", "again"), [("guessed", NEW), ("the-old-one-2", "another")])
def test_a_mistake_changes_nothing_and_is_named(client, ann, old, again):
    answer = change(client, ann, old, again)
    assert '<p class="bad small" role="alert">' in answer.content.decode()
    assert not User.objects.get().check_password(NEW)


def test_a_stranger_is_sent_to_the_login(client):
    assert client.get("/password/").url.startswith("/login/")


def test_guesses_of_the_old_one_are_counted_and_locked_as_at_a_login_and_end_no_session(client, ann):
    for _ in range(settings.AXES_FAILURE_LIMIT - 1):
        assert change(client, ann, "guessed").status_code == 200
    locked = change(client, ann, "guessed")
    assert (locked.status_code, "Retry-After" in locked) == (429, True)
    assert change(client, ann, "the-old-one-2").status_code == 429
    assert login(address="127.0.0.1", password="the-old-one-2").status_code == 429, "they are one count"
    assert client.get("/").status_code == 200
    assert not User.objects.get().check_password(NEW)


def test_the_right_one_forgets_the_guesses(client, ann):
    change(client, ann, "guessed")
    assert AccessAttempt.objects.exists()
    assert change(client, ann, "the-old-one-2").status_code == 302
    assert not AccessAttempt.objects.exists()


def test_the_administration_has_no_page_of_its_own_where_nobody_counts(client, alma):
    client.force_login(alma)
    answer = client.post("/admin/password_change/", {"old_password": "guessed"})
    assert (answer.status_code, answer.url) == (302, "/password/")


def test_where_too_many_passwords_are_being_checked_it_says_so(client, ann, settings, monkeypatch):
    settings.PASSWORD_HASHERS = ["evaweb.accounts.password_hashing.QueuedHasher"]
    monkeypatch.setattr(password_hashing.QueuedHasher, "iterations", 1)
    ann.set_password("the-old-one-2")
    ann.save()
    client.force_login(ann)
    monkeypatch.setattr(password_hashing._turns, "_place_for", lambda share, answer: answer)
    answer = client.post(
        "/password/", {"old_password": "the-old-one-2", "new_password1": NEW, "new_password2": NEW}
    )
    assert (answer.status_code, "too many passwords" in answer.json()["error"]) == (503, True)
