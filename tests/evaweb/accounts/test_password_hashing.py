"""Passwords: hashed one after the other, and not for as many as like to ask."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
from django.contrib.auth.hashers import PBKDF2PasswordHasher, check_password, make_password

from evaweb.accounts import password_hashing
from evaweb.accounts.client_addresses import SHARE
from evaweb.accounts.lookup_pool import FairLookupPool
from evaweb.accounts.password_hashing import HashingOverload, QueuedHasher
from tests.processes import PATIENCE_S, eventually


@pytest.fixture
def slow(monkeypatch):
    """Hashing lasts until the test ends it, and says of what and in which thread it was done."""
    begun, may_end, hashed = threading.Semaphore(0), threading.Event(), []

    def encode(self, password, salt, iterations=None):
        hashed.append((password, threading.current_thread().name))
        begun.release()
        assert may_end.wait(PATIENCE_S)
        return password

    monkeypatch.setattr(PBKDF2PasswordHasher, "encode", encode)
    yield begun, may_end, hashed
    may_end.set()


@pytest.mark.exhaustive
def test_a_hash_is_that_of_django(settings):
    settings.PASSWORD_HASHERS = ["django.contrib.auth.hashers.PBKDF2PasswordHasher"]
    before = make_password("three words")
    settings.PASSWORD_HASHERS = ["evaweb.accounts.password_hashing.QueuedHasher"]
    assert check_password("three words", before)
    assert not check_password("guessed", before)
    assert make_password("three words").startswith("pbkdf2_sha256$")


@pytest.fixture
def turns(monkeypatch):
    """Three wait, behind the one that is hashed."""
    made = FairLookupPool(1, 3, "passwords", password_hashing._lower_priority)
    monkeypatch.setattr(password_hashing, "_turns", made)
    return made


def test_a_crowd_of_one_address_waits_behind_itself_and_its_last_are_sent_away(slow, turns):
    begun, may_end, hashed = slow
    done = []

    def log_in(address, password):
        SHARE.set(address)
        try:
            done.append(QueuedHasher().encode(password, "salt"))
        except HashingOverload as busy:
            done.append(str(busy))

    with ThreadPoolExecutor(6) as people:
        log_ins = [people.submit(log_in, "crowd", "first")]
        assert begun.acquire(timeout=PATIENCE_S)
        log_ins += [people.submit(log_in, "crowd", f"{number}") for number in range(4)]
        eventually(lambda: (turns._waiting, len(done)) == (3, 1), "the crowd")
        log_ins.append(people.submit(log_in, "10.0.0.9", "ann's"))
        eventually(lambda: len(done) == 2, "one of the crowd that gives way")
        may_end.set()
        for one in log_ins:
            one.result(PATIENCE_S)
    assert sum("try again" in one for one in done) == 2
    order, threads = zip(*hashed, strict=True)
    assert (order[0], order.index("ann's") <= 2, len(order)) == (
        "first",
        True,
        4,
    )  # behind one of the crowd at most
    assert {name.rpartition("_")[0] for name in threads} == {"passwords"}
    assert len(set(threads)) == 1


@pytest.mark.django_db
def test_who_logs_in_when_too_many_do_is_told_when_to_try_again(client, settings, monkeypatch):
    settings.PASSWORD_HASHERS = ["evaweb.accounts.password_hashing.QueuedHasher", *settings.PASSWORD_HASHERS]
    monkeypatch.setattr(password_hashing._turns, "_place_for", lambda share, answer: answer)
    answer = client.post("/login/", {"username": "nobody", "password": "x"}, headers={"Accept": "text/html"})
    assert (answer.status_code, answer["Retry-After"]) == (503, "5")
    assert "try again in a few seconds" in answer.content.decode()
