"""People enter, replace and remove their own Hugging Face token; it is encrypted and never shown again."""

import logging

import pytest
from django.apps import apps
from django.contrib.auth.models import User
from django.urls import reverse

from evaweb.accounts import hub_tokens
from evaweb.accounts.hub_tokens import (
    HubAccount,
    choose_hub_account,
    describe_hub_login,
    load_hub_token,
    store_hub_token,
)
from evaweb.accounts.models import HubToken
from evaweb.core.environment import HUB_KEY
from evaweb.core.errors import Conflict, EvaError, NotAllowed
from evaweb.core.file_checks import check_private_files
from tests.evaweb.conftest import person

pytestmark = pytest.mark.django_db
ANNS, NEW, BOBS = "hf_AnnAnnAnnAnnAnnAnn1111", "hf_NewNewNewNewNewNew2222", "hf_BobBobBobBobBobBob3333"


@pytest.fixture(autouse=True)
def data(settings, tmp_path):
    settings.DATA_DIR = tmp_path
    return tmp_path


def save(client, token):
    return client.post(reverse("account"), {"token": token, "what": "token"}, follow=True)


def loaded(user):
    token, name = load_hub_token(person=user.pk, account=HubAccount.OWN)
    assert name == user.get_username()
    return token.get_secret_value()


def test_a_token_is_saved_replaced_and_removed_by_its_person_alone(client, ann, bob):
    client.force_login(ann)
    assert "None. Your pushes and pulls use the lab" in client.get(reverse("account")).content.decode()
    page = save(client, f" {ANNS}\n").content.decode()
    assert "Set, ends in" in page
    assert "…1111" in page
    store_hub_token(user=bob, text=BOBS)
    assert "…2222" in save(client, NEW).content.decode()
    assert (loaded(ann), loaded(bob)) == (NEW, BOBS)
    client.post(reverse("account"), {"what": "remove-token", "user": bob.pk, "username": "bob"})
    assert list(HubToken.objects.values_list("user__username", flat=True)) == ["bob"]
    assert describe_hub_login(ann).account == HubAccount.LAB


def test_no_page_answer_log_table_or_repr_has_it(client, ann, caplog):
    caplog.set_level(logging.DEBUG)
    client.force_login(ann)
    texts = [save(client, ANNS), client.get(reverse("account")), client.get(reverse("api:me"))]
    client.force_login(person("alma", "admin"))
    texts += [
        client.get(reverse("admin:accounts_hubtoken_changelist")),
        client.get(reverse("admin:accounts_hubtoken_change", args=[ann.pk])),
    ]
    row = HubToken.objects.get()
    assert [ANNS in text.content.decode() for text in texts] == [False] * 5
    assert row.encrypted not in texts[-1].content.decode()
    assert texts[-1].status_code == 200
    assert ANNS not in caplog.text
    assert "'ann' has entered a Hugging Face token" in caplog.text
    tables = repr([list(model.objects.values()) for model in apps.get_models()])
    assert row.encrypted in tables
    assert ANNS not in tables
    assert ANNS not in repr(
        (row, str(row), describe_hub_login(ann), load_hub_token(person=ann.pk, account="own"))
    )


@pytest.mark.parametrize(
    "typed", ["", "secret password", "hf_short", f"{ANNS} {BOBS}", "hf_ü" * 9, "x" + ANNS]
)
def test_what_is_no_token_is_refused_and_not_repeated(client, ann, typed, caplog):
    client.force_login(ann)
    answer = save(client, typed)
    assert answer.status_code == 400
    assert "this is no token of Hugging Face" in answer.content.decode()
    assert not typed or (typed not in answer.content.decode() and typed not in caplog.text)
    assert not HubToken.objects.exists()


def test_another_key_of_the_lab_makes_it_absent_with_a_sentence(client, ann, settings, data):
    store_hub_token(user=ann, text=ANNS)
    assert (data / HUB_KEY).stat().st_mode & 0o777 == 0o600
    client.force_login(ann)

    def is_refused():
        with pytest.raises(Conflict, match="stored with another key of this lab"):
            choose_hub_account(ann)
        with pytest.raises(Conflict, match="stored with another key of this lab"):
            loaded(ann)
        assert "cannot be read any more" in client.get(reverse("account")).content.decode()

    key, secret = (data / HUB_KEY).read_bytes(), settings.SECRET_KEY
    settings.SECRET_KEY = "another"
    client.force_login(ann)
    is_refused()
    settings.SECRET_KEY = secret
    (data / HUB_KEY).unlink()  # as after a backup was restored
    client.force_login(ann)
    is_refused()
    (data / HUB_KEY).write_bytes(b"")
    is_refused()
    (data / HUB_KEY).write_bytes(key)
    assert loaded(ann) == ANNS
    (data / HUB_KEY).write_bytes(b"")
    store_hub_token(user=ann, text=NEW)
    assert loaded(ann) == NEW


@pytest.mark.parametrize("debug", [False, True])
def test_a_traceback_does_not_show_it(client, ann, settings, monkeypatch, caplog, debug):
    def fail():
        raise RuntimeError("the disk is gone")

    settings.DEBUG = debug
    monkeypatch.setattr(hub_tokens, "_key", fail)
    client.raise_request_exception = False
    client.force_login(ann)
    answer = save(client, ANNS)
    assert answer.status_code == 500
    assert ("the disk is gone" in answer.content.decode()) is debug
    assert "the disk is gone" in caplog.text
    assert ANNS not in answer.content.decode() + caplog.text


def test_a_row_is_of_no_use_to_another_person(ann, bob):
    store_hub_token(user=ann, text=ANNS)
    store_hub_token(user=bob, text=BOBS)
    HubToken.objects.filter(user=bob).update(encrypted=HubToken.objects.get(user=ann).encrypted)
    with pytest.raises(Conflict, match="cannot be read"):
        loaded(bob)


def test_who_is_switched_off_has_none_and_gets_none(ann):
    store_hub_token(user=ann, text=ANNS)
    User.objects.filter(pk=ann.pk).update(is_active=False)
    with pytest.raises(NotAllowed, match="ann ordered this, and that account is switched off"):
        loaded(ann)
    User.objects.filter(pk=ann.pk).update(is_active=True)
    ann.refresh_from_db()
    ann.is_active = False
    ann.save()
    assert not HubToken.objects.exists()
    ann.delete()
    with pytest.raises(NotAllowed, match="does not exist any more"):
        load_hub_token(person=10**6, account="own")


def test_without_one_the_lab_lends_its_account_only_if_it_is_to(ann, settings):
    assert choose_hub_account(ann) == HubAccount.LAB
    assert load_hub_token(person=None, account="") == (None, "")  # of an earlier version
    settings.EVA_HUB_LAB_ACCOUNT = False
    with pytest.raises(EvaError, match="enter yours under Your account"):
        choose_hub_account(ann)
    for one in (ann.pk, None):
        with pytest.raises(NotAllowed, match="EVA_HUB_LAB_ACCOUNT"):
            load_hub_token(person=one, account="lab")


def test_an_administrator_removes_a_token_and_cannot_write_one(client, ann, caplog):
    caplog.set_level(logging.INFO)
    store_hub_token(user=ann, text=ANNS)
    client.force_login(person("alma", "admin"))
    assert client.get(reverse("admin:accounts_hubtoken_add")).status_code == 403
    address = reverse("admin:accounts_hubtoken_change", args=[ann.pk])
    assert client.post(address, {"ending": "zzzz"}).status_code == 403
    client.post(reverse("admin:accounts_hubtoken_delete", args=[ann.pk]), {"post": "yes"})
    assert not HubToken.objects.exists()
    assert "the Hugging Face token of 'ann' is removed by 'alma'" in caplog.text


def test_a_key_that_others_can_read_is_named(ann, data):
    store_hub_token(user=ann, text=ANNS)
    (data / HUB_KEY).chmod(0o644)
    assert any(HUB_KEY in warning.msg for warning in check_private_files())


def test_a_stranger_is_sent_to_the_login(client):
    assert save(client, ANNS).redirect_chain[0][0].startswith("/login/")
    assert not HubToken.objects.exists()
