"""Logins that fail are counted by name and address together, and logged; nothing that is logged in notices."""

import logging
from datetime import timedelta

import pytest
from axes.models import AccessAttempt
from django.conf import settings
from django.core.management import call_command
from django.db import connection
from django.test import Client
from django.test.utils import CaptureQueriesContext
from django.utils import timezone

from evaweb.accounts import login_audit
from evaweb.api.tokens import create_token
from evaweb.core.log_throttle import LogThrottle
from evaweb.serving.lockout_page import MOST_NAMES
from tests.evaweb.trials import builders

pytestmark = pytest.mark.django_db
WRONG, MOST = "not-the-one", settings.AXES_FAILURE_LIMIT


@pytest.fixture
def ann(db):
    return builders.user("ann")


def login(name="ann", password=WRONG, path="/login/", address="10.0.0.5", **headers):
    data = {"username": name, "password": password}
    headers = {"accept": "text/html", **headers}
    return Client().post(path, data, headers=headers, REMOTE_ADDR=address)


def locked(**where):
    for _ in range(MOST - 1):
        assert login(**where).status_code == 200
    return login(**where)


@pytest.mark.parametrize("path", ["/login/", "/admin/login/"])
def test_after_a_few_wrong_passwords_the_name_is_locked_there_and_the_page_says_how_long(ann, path):
    answer = locked(path=path)
    assert answer.status_code == 429
    assert "Try again in 15 minutes" in answer.content.decode()
    assert 0 < int(answer["Retry-After"]) <= 900
    right = login(password="ann", path=path)
    assert right.status_code == 429
    assert settings.SESSION_COOKIE_NAME not in right.cookies


def test_others_and_other_addresses_are_not_locked(ann):
    builders.user("bob")
    assert locked().status_code == 429
    assert login(password="ann", address="10.0.0.6").status_code == 302
    assert login("bob", "bob").status_code == 302


def test_another_address_of_the_same_network_of_ipv6_is_no_other_one(ann):
    for number in range(MOST):
        answer = login(address=f"2001:db8:1:2::{number + 1:x}")
    assert answer.status_code == 429
    assert login(password="ann", address="2001:db8:1:2:ffff::9").status_code == 429
    assert login(password="ann", address="2001:db8:1:3::1").status_code == 302


def test_who_guesses_many_names_is_locked_for_all_at_that_address_until_they_are_fewer(ann):
    for number in range(MOST_NAMES):
        assert login(f"name{number}").status_code == 200
    for name, password in (("ann", "ann"), ("another", WRONG)):
        answer = login(name, password)
        assert answer.status_code == 429
        assert (
            f"wrong for {MOST_NAMES} names from this computer. Try again in 15 min" in answer.content.decode()
        )
        assert 0 < int(answer["Retry-After"]) <= 900
    assert not AccessAttempt.objects.filter(username__in=("ann", "another")).exists()  # it is not prolonged
    assert login(password="ann", address="10.0.0.6").status_code == 302
    first = AccessAttempt.objects.filter(username="name0")
    first.update(attempt_time=timezone.now() - settings.AXES_COOLOFF_TIME)
    assert login(password="ann").status_code == 302


def test_the_lock_ends_by_itself_and_trying_does_not_prolong_it(ann):
    locked()
    AccessAttempt.objects.update(attempt_time=timezone.now() - timedelta(minutes=14))
    answer = login(password="ann")
    assert "Try again in 1 minute;" in answer.content.decode()
    AccessAttempt.objects.update(attempt_time=timezone.now() - timedelta(minutes=16))
    assert login(password="ann").status_code == 302


def test_the_right_password_forgets_the_wrong_ones(ann):
    for _ in range(MOST - 1):
        login()
    assert login(password="ann").status_code == 302
    assert not AccessAttempt.objects.exists()


def test_an_administrator_unlocks_by_command_or_by_removing_the_row(ann, alma, client):
    locked()
    call_command("axes_reset_ip_username", "10.0.0.5", "ann")
    assert login(password="ann").status_code == 302
    locked()
    client.force_login(alma)
    page = client.get("/admin/axes/accessattempt/").content.decode()
    assert "10.0.0.5" in page
    assert WRONG not in page
    chosen = {
        "action": "delete_selected",
        "_selected_action": [AccessAttempt.objects.get().pk],
        "post": "yes",
    }
    assert client.post("/admin/axes/accessattempt/", chosen).status_code == 302
    assert login(password="ann").status_code == 302


def test_nothing_is_kept_of_a_password(ann):
    locked()
    assert WRONG not in str(list(AccessAttempt.objects.values()))


def test_who_is_logged_in_goes_on_and_stops_while_the_name_is_locked(ann, live):
    client = Client(REMOTE_ADDR="10.0.0.5")
    client.force_login(ann)
    token = create_token(user=ann, name="pedal")
    assert locked().status_code == 429
    assert client.get("/").status_code == 200
    press = f"/api/v1/stations/{live.name}/estop"
    with CaptureQueriesContext(connection) as asked:
        by_page = client.post(press, "{}", content_type="application/json")
        bearer = {"authorization": f"Bearer {token}"}
        by_token = Client(REMOTE_ADDR="10.0.0.5").post(
            press, "{}", content_type="application/json", headers=bearer
        )
    assert (by_page.status_code, by_token.status_code) == (200, 200)
    assert not [query["sql"] for query in asked if "axes" in query["sql"]]


def test_a_name_that_nobody_has_is_locked_as_well_and_not_logged(db, caplog):
    assert locked(name="Hunter2").status_code == 429
    said = [row.getMessage() for row in caplog.records if row.name == "evaweb.accounts.login_audit"]
    assert said[0] == "login of an unknown name (7 characters) failed from 10.0.0.5"
    assert "Hunter2" not in caplog.text


def test_logins_and_logouts_are_logged(ann, caplog):
    caplog.set_level(logging.INFO)
    client = Client(REMOTE_ADDR="10.0.0.5")
    client.post("/login/", {"username": "ann", "password": WRONG})
    client.post("/login/", {"username": "ann", "password": "ann"})
    client.post("/logout/")
    assert [row.getMessage() for row in caplog.records if row.name == "evaweb.accounts.login_audit"] == [
        "login of 'ann' failed from 10.0.0.5",
        "'ann' has logged in from 10.0.0.5",
        "'ann' has logged out from 10.0.0.5",
    ]
    assert WRONG not in caplog.text


def test_control_characters_of_a_name_are_escaped(caplog):
    caplog.set_level(logging.INFO)
    builders.user("ann\n2026 INFO forged\x1b[2J\u202e")
    client = Client()
    client.force_login(builders.User.objects.get())
    assert caplog.messages == ["'ann\\n2026 INFO forged\\x1b[2J\\u202e' has logged in from nowhere"]


def test_refused_tokens_are_logged_once_a_minute_for_an_address(monkeypatch, caplog):
    now = [100.0]
    monkeypatch.setattr(login_audit, "_refused", LogThrottle(60.0, 10, clock=lambda: now[0]))
    for _ in range(3):
        login_audit.log_token_refused("10.0.0.5", "is not known")
    now[0] += 61
    login_audit.log_token_refused("10.0.0.5", "is not known")
    assert caplog.messages == [
        "a token from 10.0.0.5 is not known",
        "a token from 10.0.0.5 is not known (2 before it)",
    ]


def test_a_crowd_of_unverified_presses_is_a_line_in_ten_seconds_of_each_station(caplog, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(login_audit, "_unverified", LogThrottle(10.0, 16, clock=lambda: now[0]))
    for _ in range(500):
        login_audit.estop_unverified("bench-1", TimeoutError("no turn"))
    login_audit.estop_unverified("bench-2", TimeoutError("no turn"))
    now[0] = 11.0
    login_audit.estop_unverified("bench-1", TimeoutError("no turn"))
    assert [record.getMessage() for record in caplog.records] == [
        "e-stop from unknown user 'bench-1' obeyed: no turn",
        "e-stop from unknown user 'bench-2' obeyed: no turn",
        "e-stop from unknown user 'bench-1' obeyed: no turn (499 before it)",
    ]
