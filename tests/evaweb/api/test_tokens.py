from io import StringIO

import pytest
from django.core.management import CommandError, call_command

from evaweb.api.models import Token
from evaweb.api.tokens import token_create, token_user
from evaweb.errors import Conflict, EvaError
from tests.evaweb.api.conftest import Rest
from tests.evaweb.trials import builders


@pytest.fixture
def ann(db):
    return builders.user("ann")


def test_a_token_is_kept_as_its_digest_alone(ann):
    secret = token_create(user=ann, name="export")
    kept = Token.objects.values().get()
    assert secret not in str(kept)
    assert len(secret) > 40
    assert token_user(secret=secret) == ann


def test_the_use_of_a_token_is_noted_but_not_each_time(ann, django_assert_num_queries):
    secret = token_create(user=ann, name="export")
    assert Token.objects.get().used_at is None
    token_user(secret=secret)
    assert Token.objects.get().used_at is not None
    with django_assert_num_queries(1):
        token_user(secret=secret)


def test_a_user_who_was_switched_off_has_no_token(ann):
    secret = token_create(user=ann, name="export")
    ann.is_active = False
    ann.save()
    assert token_user(secret=secret) is None
    assert Rest(secret).get("me")[0] == 401


def test_names_of_tokens_are_given_once(ann):
    token_create(user=ann, name="export")
    with pytest.raises(Conflict, match="revoke it"):
        token_create(user=ann, name=" export ")
    with pytest.raises(EvaError, match="1 to 80 characters"):
        token_create(user=ann, name=" ")


def test_the_command_prints_the_token_and_nothing_else(ann):
    out = StringIO()
    call_command("api_token", "ann", "export", stdout=out)
    assert Rest(out.getvalue().strip()).get("me")[1]["username"] == "ann"


def test_the_command_names_the_users_there_are(ann):
    with pytest.raises(CommandError, match="there are: ann"):
        call_command("api_token", "bob", "export")
    token_create(user=ann, name="export")
    with pytest.raises(CommandError, match="revoke it"):
        call_command("api_token", "ann", "export")
