"""What is absent is said when a process starts."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError

from django.core.checks import run_checks

from evaweb import settings
from evaweb.console import checks


def test_scripts_that_are_absent_are_warned_of_with_what_brings_them(monkeypatch):
    monkeypatch.setattr(checks.finders, "find", lambda name: None if "uplot" in name else name)
    (warning,) = [found for found in run_checks() if found.id and found.id.startswith("console.")]
    assert warning.id == "console.W001"
    assert warning.msg == "uplot/uPlot.esm.js is absent: pages are shown without curves"
    assert warning.hint == "make setup brings it"


def test_the_viewer_is_installed():
    assert checks.finders.find("meshcat/main.min.js")


def test_where_meshcat_is_not_installed_there_is_no_folder_of_it(monkeypatch):
    def absent(name):
        raise PackageNotFoundError(name)

    monkeypatch.setattr(settings, "files", absent)
    assert settings._viewer() is None
