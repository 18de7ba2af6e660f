"""What is absent is said when a process starts."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError

import pytest
from django.core.checks import run_checks

from evaweb import settings
from evaweb.console import checks
from evaweb.console.management.commands import stops
from evaweb.jobs.management.commands import worker


def test_scripts_that_are_absent_are_warned_of_with_what_brings_them(monkeypatch):
    monkeypatch.setattr(checks.finders, "find", lambda name: None if "uplot" in name else name)
    (warning,) = [found for found in run_checks() if found.id and found.id.startswith("console.")]
    assert warning.id == "console.W001"
    assert warning.msg == "uplot/uPlot.iife.min.js is absent: pages are shown without curves"
    assert warning.hint == "make setup brings it"


def test_the_viewer_is_installed():
    assert checks.finders.find("meshcat/main.min.js")


def test_where_meshcat_is_not_installed_there_is_no_folder_of_it(monkeypatch):
    def absent(name):
        raise PackageNotFoundError(name)

    monkeypatch.setattr(settings, "files", absent)
    assert settings._viewer() is None


@pytest.mark.parametrize("command", [stops.Command, worker.Command])
def test_a_process_without_pages_refuses_a_wrong_origin_and_warns_of_what_others_read(
    command, settings, tmp_path
):
    tmp_path.chmod(0o755)
    settings.DATA_DIR = tmp_path
    settings.CSRF_TRUSTED_ORIGINS = ["lab.example"]
    found = {message.id for message in run_checks(tags=command.requires_system_checks)}
    assert {"4_0.E001", "evaweb.W001"} <= found
