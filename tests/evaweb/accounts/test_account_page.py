"""People state their ORCID iD on the page of their own account."""

import pytest
from django.urls import reverse

from evaweb.accounts.models import Profile
from evaweb.accounts.profiles import orcids_of

pytestmark = pytest.mark.django_db
ORCID = "0000-0002-1694-233X"


def save(client, orcid):
    return client.post(reverse("account"), {"orcid": orcid}, follow=True)


def test_an_orcid_is_saved_shown_and_removed(client, ann):
    client.force_login(ann)
    page = save(client, f" https://orcid.org/{ORCID.lower()} ").content.decode()
    assert f'value="{ORCID}"' in page
    assert client.get(reverse("api:me")).json()["orcid"] == ORCID
    assert orcids_of(["ann", "bob"]) == {"ann": ORCID}
    assert ORCID not in save(client, "").content.decode()
    assert orcids_of(["ann"]) == {}


@pytest.mark.parametrize(
    ("typed", "why"), [("0000-0002-1694-2331", "wrong check digit"), ("42", "allowed: the form 0000-")]
)
def test_a_mistyped_one_is_named_and_kept_in_the_field_alone(client, ann, typed, why):
    client.force_login(ann)
    answer = save(client, typed)
    assert answer.status_code == 400
    assert why in answer.content.decode()
    assert f'value="{typed}"' in answer.content.decode()
    assert not Profile.objects.exists()


def test_a_stranger_is_sent_to_the_login(client):
    assert client.get(reverse("account")).url.startswith("/login/")
