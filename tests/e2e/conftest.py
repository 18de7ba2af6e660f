import shutil
from pathlib import Path

import pytest

from tests.e2e.lab import CHROMIUM, NO_CHROMIUM, Demo, browsing


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """One demo lab per module; its log is shown where it did not end well."""
    lab = Demo(tmp_path_factory.mktemp("demo")).start()
    yield lab
    assert lab.end() == 0, (lab.folder / "demo.log").read_text()[-2000:]


@pytest.fixture(scope="session")
def shared(tmp_path_factory):
    """A lab with more people and a dead checkpoint, for modules that leave its station in order."""
    lab = Demo(tmp_path_factory.mktemp("shared"), EVA_JOB_STALE_S="6").start().people()
    yield lab
    if lab.runs:
        assert lab.end() == 0, (lab.folder / "demo.log").read_text()[-2000:]


@pytest.fixture(scope="module")
def browser():
    if not (shutil.which("chromium") or Path(CHROMIUM).exists()):
        pytest.skip(NO_CHROMIUM)
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright, browsing(playwright) as opened:
        yield opened
