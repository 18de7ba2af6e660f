"""Passwords: hashed one after the other, and not for as many as like to ask."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
from django.contrib.auth.hashers import PBKDF2PasswordHasher, check_password, make_password

from evaweb import hashing
from evaweb.hashing import Busy, QueuedHasher
from tests.processes import PATIENCE_S


@pytest.fixture
def slow(monkeypatch):
    """Hashing lasts until the test ends it, and says in which thread it is done."""
    begun, may_end, threads = threading.Semaphore(0), threading.Event(), []

    def encode(self, password, salt, iterations=None):
        threads.append(threading.current_thread().name)
        begun.release()
        assert may_end.wait(PATIENCE_S)
        return password

    monkeypatch.setattr(PBKDF2PasswordHasher, "encode", encode)
    yield begun, may_end, threads
    may_end.set()


@pytest.mark.exhaustive
def test_a_hash_is_that_of_django(settings):
    settings.PASSWORD_HASHERS = ["django.contrib.auth.hashers.PBKDF2PasswordHasher"]
    before = make_password("three words")
    settings.PASSWORD_HASHERS = ["evaweb.hashing.QueuedHasher"]
    assert check_password("three words", before)
    assert not check_password("guessed", before)
    assert make_password("three words").startswith("pbkdf2_sha256$")


def test_of_many_at_once_one_thread_hashes_and_the_last_are_sent_away(slow, monkeypatch):
    begun, may_end, threads = slow
    monkeypatch.setattr(hashing, "_places", threading.BoundedSemaphore(3))
    with ThreadPoolExecutor(3) as people:
        waiting = [people.submit(QueuedHasher().encode, f"{number}", "salt") for number in range(3)]
        assert begun.acquire(timeout=PATIENCE_S)
        while hashing._places._value:
            threading.Event().wait(0.01)
        with pytest.raises(Busy, match="try again"):
            QueuedHasher().encode("x", "salt")
        assert len(threads) == 1
        may_end.set()
        assert {one.result(PATIENCE_S) for one in waiting} == {"0", "1", "2"}
    assert {name.rpartition("_")[0] for name in threads} == {"passwords"}


@pytest.mark.django_db
def test_who_logs_in_when_too_many_do_is_told_to_try_again(client, settings, monkeypatch):
    settings.PASSWORD_HASHERS = ["evaweb.hashing.QueuedHasher", *settings.PASSWORD_HASHERS]
    monkeypatch.setattr(hashing, "_places", threading.BoundedSemaphore(1))
    hashing._places.acquire()
    answer = client.post("/login/", {"username": "nobody", "password": "x"}, headers={"Accept": "text/html"})
    assert answer.status_code == 503
    assert "try again in a few seconds" in answer.content.decode()
