import logging
from datetime import timedelta
from importlib import import_module
from io import StringIO

import pytest
from django.contrib.auth.hashers import make_password
from django.contrib.auth.models import User
from django.core.management import CommandError, call_command
from django.utils import timezone

from evaweb.api.models import Token
from evaweb.api.tokens import create_token, user_of_token
from evaweb.core.errors import Conflict, EvaError
from tests.evaweb.api.conftest import Rest
from tests.evaweb.trials import builders


@pytest.fixture
def ann(db):
    return builders.user("ann")


def test_a_token_is_kept_as_its_digest_alone(ann):
    secret = create_token(user=ann, name="export")
    kept = Token.objects.values().get()
    assert secret not in str(kept)
    assert len(secret) > 40
    assert user_of_token(secret=secret) == ann


def test_the_use_of_a_token_is_noted_but_not_each_time(ann, django_assert_num_queries):
    secret = create_token(user=ann, name="export")
    assert Token.objects.get().used_at is None
    user_of_token(secret=secret)
    assert Token.objects.get().used_at is not None
    with django_assert_num_queries(1):
        user_of_token(secret=secret)


def test_a_user_who_was_switched_off_has_no_token(ann):
    secret = create_token(user=ann, name="export")
    ann.is_active = False
    ann.save()
    assert user_of_token(secret=secret) is None
    assert Rest(secret).get("me")[0] == 401


def test_names_of_tokens_are_given_once(ann):
    create_token(user=ann, name="export")
    with pytest.raises(Conflict, match="revoke it"):
        create_token(user=ann, name=" export ")
    with pytest.raises(EvaError, match="1 to 80 characters"):
        create_token(user=ann, name=" ")


def test_the_command_prints_the_token_and_nothing_else(ann):
    out = StringIO()
    call_command("api_token", "ann", "export", stdout=out)
    assert Rest(out.getvalue().strip()).get("me")[1]["username"] == "ann"


def test_the_command_names_the_users_there_are(ann):
    with pytest.raises(CommandError, match="there are: ann"):
        call_command("api_token", "bob", "export")
    create_token(user=ann, name="export")
    with pytest.raises(CommandError, match="revoke it"):
        call_command("api_token", "ann", "export")


def test_a_token_ends(ann):
    secret = create_token(user=ann, name="export", days=1)
    assert timedelta(hours=23) < Token.objects.get().ends_at - timezone.now() <= timedelta(days=1)
    Token.objects.update(ends_at=timezone.now())
    status, said = Rest(secret).get("me")
    assert status == 401
    assert "its time is over" in said["error"]
    assert user_of_token(secret=secret, ended=True) == ann


@pytest.mark.parametrize("days", [0, -1, 367])
def test_no_token_is_for_ever(ann, days):
    with pytest.raises(EvaError, match=f"days = {days}; allowed: 1 to 366"):
        create_token(user=ann, name="export", days=days)
    with pytest.raises(CommandError, match="allowed: 1 to 366"):
        call_command("api_token", "ann", "export", f"--days={days}")


def test_tokens_of_before_end_ninety_days_after_the_update():
    migration = import_module("evaweb.api.migrations.0002_token_ends")
    left = migration.ninety_days_from_now() - timezone.now()
    assert timedelta(days=89) < left <= timedelta(days=90)


def set_password(user):
    user.set_password("another-one-3")
    user.save()


def set_none(user):
    user.set_unusable_password()
    user.save()


def set_hash(user):
    user.password = make_password("another-one-3")
    user.save()


def switch_off(user):
    user.is_active = False
    user.save(update_fields=["is_active"])


@pytest.mark.parametrize("change", [set_password, set_none, set_hash, switch_off])
def test_tokens_are_withdrawn_with_the_password_and_with_the_account(ann, change, caplog):
    caplog.set_level(logging.INFO)
    secret = create_token(user=ann, name="export")
    other = create_token(user=builders.user("bob"), name="export")
    change(User.objects.get(username="ann"))
    User.objects.filter(username="ann").update(is_active=True)
    assert Rest(secret).get("me")[0] == 401
    assert Rest(other).get("me")[0] == 200
    assert "token 'export' of 'ann' is withdrawn: the" in caplog.text


def test_a_password_that_is_hashed_anew_at_a_login_keeps_the_tokens(ann, settings, client):
    secret = create_token(user=ann, name="export")
    settings.PASSWORD_HASHERS = [
        "django.contrib.auth.hashers.PBKDF2PasswordHasher",
        "django.contrib.auth.hashers.MD5PasswordHasher",
    ]
    assert client.post("/login/", {"username": "ann", "password": "ann"}).status_code == 302
    assert User.objects.get().password.startswith("pbkdf2")
    assert Rest(secret).get("me")[0] == 200


def test_what_is_no_token_costs_no_question_to_the_database(ann, django_assert_num_queries):
    with django_assert_num_queries(0):
        assert [user_of_token(secret=text) for text in ("", "eva_", "x" * 47, "eva_" + "x" * 3000)] == [
            None
        ] * 4


def test_tokens_are_logged_when_they_are_made_and_withdrawn(ann, alma, client, caplog):
    caplog.set_level(logging.INFO)
    secret = create_token(user=ann, name="export")
    client.force_login(alma)
    chosen = {"action": "delete_selected", "_selected_action": [Token.objects.get().pk], "post": "yes"}
    assert client.post("/admin/api/token/", chosen).status_code == 302
    assert "token 'export' of 'ann' is made, until " in caplog.text
    assert "token 'export' of 'ann' is withdrawn by 'alma'" in caplog.text
    assert secret not in caplog.text
    assert Rest(secret).get("me")[0] == 401
