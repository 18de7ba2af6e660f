"""Stops that are being written down, by threads that go on after a test's last line."""

from __future__ import annotations

from django.conf import settings

from evaweb.stations import commands
from tests.processes import eventually


def wait_for_stop_records() -> None:
    """Return when none waits any more."""
    eventually(lambda: not commands.notes._waiting and not list(_files()), "stops are written down")


def _files():
    return (settings.DATA_DIR / "unwritten").glob("*.json")
