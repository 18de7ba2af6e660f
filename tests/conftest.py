"""What holds for every test: which need the machine for themselves, and that none runs in a real-time class."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import pytest

_ALONE = [Path(__file__).parent / folder for folder in ("e2e", "crash")]  # whole labs, and what ends them
_BEGAN = os.sched_getscheduler(0)
hypothesis.settings.register_profile("eva", deadline=None)  # no test asserts timing: others share the machine
hypothesis.settings.load_profile("eva")
_SOCKETS = tempfile.mkdtemp(prefix="eva-")  # of every station that a test starts


def pytest_configure() -> None:
    """Whatever started the tests, they are ordinary: else a busy one starves the real-time loops it looks at."""
    if _BEGAN != os.SCHED_OTHER:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    os.environ["XDG_RUNTIME_DIR"] = _SOCKETS


def pytest_unconfigure() -> None:
    """No socket of a test outlives the tests."""
    shutil.rmtree(_SOCKETS, ignore_errors=True)


def pytest_report_header() -> str:
    """The class in which the tests were started, for whoever wonders about times."""
    return f"started in the scheduling class {_BEGAN}"


@pytest.hookimpl(tryfirst=True)  # before -m chooses
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what `make test` does not run beside anything else."""
    for item in items:
        if any(folder in item.path.parents for folder in _ALONE):
            item.add_marker("alone")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown() -> Iterator[None]:
    """A test that turned its own process real-time is named."""
    try:
        return (yield)
    finally:
        left = os.sched_getscheduler(0)
        if left != os.SCHED_OTHER:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
            pytest.fail(f"the test left its process in the scheduling class {left}")
