"""Cursors of transactions that could not begin, and the thread whose garbage collection finds them."""

from __future__ import annotations

import gc
import threading
import time

import pytest
from django.conf import settings
from django.db import OperationalError, transaction
from django.db.utils import ConnectionHandler

from tests.processes import PATIENCE_S

_PATIENCE_S = (
    10.0  # of the one that waits: enough for the other on a busy machine, spent in full only where it fails
)
_SOON_S = 0.3


@pytest.fixture
def databases(tmp_path, django_db_blocker):
    default = settings.DATABASES["default"]
    if not default["ENGINE"].endswith("sqlite3"):
        pytest.skip("of SQLite alone")
    with django_db_blocker.unblock():
        yield ConnectionHandler({"default": {**default, "NAME": tmp_path / "eva.sqlite3", "TEST": {}}})


def test_a_thread_that_has_the_database_never_waits_for_those_that_wait_for_it(databases, monkeypatch):
    """A locked database leaves an error that refers to itself: whoever collects garbage next ends its cursor."""
    monkeypatch.setattr(transaction, "get_connection", lambda using=None: databases["default"])
    refused, begun = threading.Event(), []

    def wait_for_it() -> None:
        _patience(databases, 0.0)
        with pytest.raises(OperationalError, match="locked"), transaction.atomic():
            raise AssertionError("the other one has it")
        _patience(databases, _PATIENCE_S)
        refused.set()
        try:
            with transaction.atomic():
                begun.append(True)
        except OperationalError as error:
            begun.append(str(error))
        databases["default"].close()

    gc.disable()
    try:
        waiting = threading.Thread(target=wait_for_it)
        with transaction.atomic():
            waiting.start()
            assert refused.wait(PATIENCE_S)
            time.sleep(
                _SOON_S
            )  # nothing tells that the other is in its wait; where it is not yet, nothing is shown
            gc.collect()
        waiting.join()
    finally:
        gc.enable()
        databases["default"].close()
    assert begun == [True]


def _patience(databases, seconds):
    with databases["default"].cursor() as cursor:
        cursor.execute(f"PRAGMA busy_timeout = {int(seconds * 1000)}")
