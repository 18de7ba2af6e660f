import re

import pytest
from django.contrib.auth.models import User
from django.db import OperationalError

from evaweb.accounts.roles import Role, role_of
from evaweb.core.errors import Conflict
from evaweb.lab import first_account

pytestmark = pytest.mark.django_db
GOOD = "a-bench-and-a-robot"


@pytest.fixture(autouse=True)
def data(settings, tmp_path):
    settings.DATA_DIR = tmp_path
    return tmp_path


def sent(client, code, username="lea", password=GOOD):
    return client.post("/first-account/", {"code": code, "username": username, "password": password})


def test_with_the_code_an_administrator_is_made_once_and_led_to_first_steps(client, data):
    code = first_account.offer()
    assert (data / "first_account").stat().st_mode & 0o077 == 0
    answer = sent(client, f" {code.upper()} ")
    assert (answer.status_code, answer["Location"]) == (302, "/first-steps/")
    user = User.objects.get()
    assert (user.username, role_of(user), user.check_password(GOOD)) == ("lea", Role.ADMIN, True)
    assert client.get("/first-steps/").status_code == 200
    assert not (data / "first_account").exists()
    assert sent(client, code, "eve")["Location"] == "/login/"
    assert User.objects.count() == 1


def test_without_the_code_nothing_is_made_and_what_was_typed_stays(client):
    first_account.offer()
    page = sent(client, "guessed", password="1").content.decode()
    assert "this is not the code" in page
    assert 'value="lea"' in page
    assert "too short" not in page  # nobody without the code has the password looked at
    assert not User.objects.exists()


def test_a_weak_password_is_refused_in_the_words_of_every_other_page(client):
    page = sent(client, first_account.offer(), password="abc").content.decode()
    assert "too short" in page
    assert not User.objects.exists()


def test_where_somebody_can_log_in_no_code_makes_another_account(client, ann):
    code = first_account.offer()
    assert not first_account.is_offered()
    assert sent(client, code)["Location"] == "/login/"
    with pytest.raises(Conflict, match="has an account already"):
        first_account.administrator_make(username="eve", password=GOOD)


def test_of_two_who_have_the_code_one_gets_the_account(data):
    first_account.offer()
    first_account.withdraw()
    with pytest.raises(Conflict, match="was used just now"):
        first_account.administrator_make(username="lea", password=GOOD)


def test_the_login_page_says_how_the_first_account_is_made(client, ann):
    def words():
        return re.sub(r"\s+", " ", client.get("/login/").content.decode())

    assert "There are no accounts" not in words()
    User.objects.update(is_active=False)
    assert "manage.py createsuperuser" in words()
    first_account.offer()
    assert 'href="/first-account/"' in words()
    assert "createsuperuser" not in words()


def test_the_login_page_is_there_without_the_database(client, monkeypatch):
    def away():
        raise OperationalError("gone")

    monkeypatch.setattr(first_account, "has_no_accounts", away)
    first_account.offer()
    page = client.get("/login/").content.decode()
    assert "Log in" in page
    assert "There are no accounts" not in page
