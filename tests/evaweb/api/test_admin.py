import pytest
from django.contrib.auth.models import User
from django.test import Client

from evaweb.accounts.roles import Role, role_of, set_role
from evaweb.api.models import Token
from evaweb.api.tokens import create_token
from tests.evaweb.trials import builders


@pytest.fixture
def root(db):
    return builders.user("root", "admin")


@pytest.fixture
def admin(root):
    made = Client()
    made.force_login(root)
    return made


def account(user, **given):
    return {"username": user.username, "role": role_of(user).value, "is_active": "on", **given}


def test_an_admin_logs_in_at_the_admin_pages_without_any_flag(root):
    assert not root.is_staff
    browser = Client()
    answer = browser.post("/admin/login/?next=/admin/", {"username": "root", "password": "root"})
    assert answer.status_code == 302
    assert browser.get("/admin/auth/user/").status_code == 200


def test_a_user_is_made_with_a_role(admin):
    words = "correct horse battery staple"
    form = {"username": "ann", "password1": words, "password2": words, "role": "operator"}
    assert admin.post("/admin/auth/user/add/", form).status_code == 302
    ann = User.objects.get(username="ann")
    assert role_of(ann) is Role.OPERATOR
    assert ann.check_password(words)


@pytest.mark.parametrize(
    ("given", "sentence"), [({"role": "king"}, "Select a valid choice"), ({"password2": "x"}, "match")]
)
def test_a_user_that_cannot_be_is_not_made(admin, given, sentence):
    words = "correct horse battery staple"
    form = {"username": "ann", "password1": words, "password2": words, "role": "viewer", **given}
    answer = admin.post("/admin/auth/user/add/", form)
    assert sentence in answer.content.decode()
    assert not User.objects.filter(username="ann").exists()


def test_a_role_is_changed_and_is_the_only_one(admin):
    ann = builders.user("ann", "operator")
    assert admin.post(f"/admin/auth/user/{ann.pk}/change/", account(ann, role="admin")).status_code == 302
    ann.refresh_from_db()
    assert (role_of(ann), ann.is_staff, list(ann.groups.values_list("name", flat=True))) == (
        Role.ADMIN,
        True,
        ["admin"],
    )


@pytest.mark.parametrize("given", [{"role": "viewer"}, {"is_active": ""}])
def test_nobody_locks_themselves_out(admin, root, given):
    answer = admin.post(f"/admin/auth/user/{root.pk}/change/", account(root, **given))
    assert "another administrator has to" in answer.content.decode()
    root.refresh_from_db()
    assert role_of(root) is Role.ADMIN
    assert root.is_active


def test_the_list_shows_and_filters_roles(admin):
    builders.user("vic", "viewer")
    builders.user("ann", "operator")
    text = admin.get("/admin/auth/user/", {"role": "operator"}).content.decode()
    assert ">ann<" in text
    assert ">vic<" not in text


def test_a_superuser_who_is_given_a_role_has_that_role_alone(db):
    boss = User.objects.create_superuser("boss")
    set_role(user=boss, role=Role.VIEWER)
    assert role_of(User.objects.get()) is Role.VIEWER


def test_tokens_are_revoked_and_not_made_there(admin, root):
    create_token(user=root, name="export")
    assert admin.get("/admin/api/token/").status_code == 200
    assert admin.get("/admin/api/token/add/").status_code == 403
    found = Token.objects.get()
    assert admin.post(f"/admin/api/token/{found.pk}/delete/", {"post": "yes"}).status_code == 302
    assert not Token.objects.exists()


def test_an_account_is_never_deleted(admin):
    ann = builders.user("ann")
    assert admin.post(f"/admin/auth/user/{ann.pk}/delete/", {"post": "yes"}).status_code == 403
    assert User.objects.filter(pk=ann.pk).exists()
