"""Everybody changes their own password."""

import pytest
from django.contrib.auth import authenticate

pytestmark = pytest.mark.django_db
NEW = "three-words-and-7"


def change(client, user, old, again=NEW):
    user.set_password("the-old-one-2")
    user.save()
    client.force_login(user)
    return client.post("/password/", {"old_password": old, "new_password1": NEW, "new_password2": again})


def test_who_knows_the_old_one_gets_a_new_one_and_stays_logged_in(client, ann):
    assert change(client, ann, "the-old-one-2").status_code == 302
    assert authenticate(username="ann", password=NEW) == ann
    assert client.get("/password/").status_code == 200


@pytest.mark.parametrize(("old", "again"), [("guessed", NEW), ("the-old-one-2", "another")])
def test_a_mistake_changes_nothing_and_is_named(client, ann, old, again):
    answer = change(client, ann, old, again)
    assert 'class="field-error"' in answer.content.decode()
    assert authenticate(username="ann", password=NEW) is None


def test_a_stranger_is_sent_to_the_login(client):
    assert client.get("/password/").url.startswith("/login/")
