"""What holds for every test: where it belongs (gate, stories, labs), and that none is left real-time."""

from __future__ import annotations

import gc
import os
import re
import shutil
import signal
import tempfile
import zlib
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import pytest

from runtime.core.environment import program_environment
from tests.once import SHARED
from tests.stalls import Stalls, Watch

_LABS = (
    "tests/e2e/",
    "tests/crash/",
)  # whole labs and stations in real time: what is there is a lab or a story
_ALONE = re.compile(r"pytest\.mark\.(?:lab|story)\b")
os.environ |= program_environment(os.environ)
_BEGAN = os.sched_getscheduler(0)
# In the gate the same examples everywhere, what fails is what was changed; and few: others come with `make labs`.
hypothesis.settings.register_profile(
    "gate", deadline=None, derandomize=True, print_blob=True, max_examples=30
)
hypothesis.settings.register_profile("random", deadline=None, derandomize=False, print_blob=True)
hypothesis.settings.load_profile("gate")
_SOCKETS = tempfile.mkdtemp(prefix="eva-")  # of every station that a test starts
_OWN = SHARED not in os.environ  # else that of the process that started this one
if _OWN:
    os.environ[SHARED] = tempfile.mkdtemp(prefix="eva-shared-")


@pytest.hookimpl(optionalhook=True)  # of xdist
def pytest_xdist_auto_num_workers() -> int:
    """Two more than there are cores: a part of the tests' time is waiting."""
    return (os.cpu_count() or 1) + 2


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """A file that has none of what is asked for is not read."""
    wanted = config.option.markexpr
    if collection_path.suffix != ".py" or not (wanted in ("story", "lab") or "not lab" in wanted):
        return None
    here = collection_path.relative_to(config.rootpath).as_posix()
    if "not lab" in wanted:
        return here.startswith(_LABS) or None
    return None if here.startswith(_LABS) or _ALONE.search(collection_path.read_text()) else True


# The files that take longest, first: else the other cores wait for the last of them.
_LONGEST = (
    "tests/evaweb/blinding/test_visibility.py",
    "tests/runtime/processes/lockstep/test_lockstep.py",
    "tests/evaweb/plans/test_design.py",
    "tests/runtime/clients/channel/test_server.py",
    "tests/runtime/transports/ros/test_rospy_middleware.py",
    "tests/evaweb/episodes/test_views.py",
    "tests/runtime/processes/control/test_encoder_offset.py",
)


def _place(item: pytest.Item) -> tuple[int, int]:
    """The others mixed, the same each time: neighbours wait for the same kind of thing, and cores would with them."""
    file = item.nodeid.partition("::")[0]
    return (_LONGEST.index(file), 0) if file in _LONGEST else (len(_LONGEST), zlib.crc32(file.encode()))


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What starts a whole lab is a lab, unless it is one of the stories; of many cases the gate makes some."""
    items.sort(key=_place)
    unread: dict[Path, bool] = {}
    cases: dict[tuple[str, str], list[pytest.Item]] = {}
    for item in items:
        if item.get_closest_marker("some") and not item.get_closest_marker("exhaustive"):
            cases.setdefault((item.path.as_posix(), item.nodeid.partition("[")[0]), []).append(item)
        story, lab = map(item.get_closest_marker, ("story", "lab"))
        if story and lab:
            raise pytest.UsageError(f"{item.nodeid} is both a story and a lab: neither command would make it")
        if item.nodeid.startswith(_LABS):
            if not story:
                item.add_marker("lab")
        elif story or lab:
            if item.path not in unread:
                unread[item.path] = not _ALONE.search(item.path.read_text())
            if unread[item.path]:
                raise pytest.UsageError(
                    f"{item.nodeid} is a story or a lab by a mark that does not stand in its file: write "
                    "pytest.mark.story or pytest.mark.lab there, or neither command reads it"
                )
    for every in cases.values():
        _leave_to_labs(every)


def _leave_to_labs(cases: list[pytest.Item]) -> None:
    """The gate makes as many cases of a test as its mark `some` says, spread over all of them; `make labs` all."""
    (count,) = next(mark.args for mark in cases[0].iter_markers("some"))
    spread = {place * len(cases) // count for place in range(count)}
    for place, case in enumerate(cases):
        if place not in spread:
            case.add_marker("exhaustive")


def pytest_collection_finish(session: pytest.Session) -> None:
    """Where whole labs are run, it is noticed when the machine stood still."""
    if any(item.get_closest_marker("story") or item.get_closest_marker("lab") for item in session.items):
        session.config.pluginmanager.register(Stalls(Watch()))


def pytest_configure() -> None:
    """Whatever started the tests, they are ordinary: else a busy one starves the real-time loops it looks at.

    Signals that a shell has its background ignore (nohup, &) end what the tests start all the same.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    if _BEGAN != os.SCHED_OTHER:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    os.environ["XDG_RUNTIME_DIR"] = _SOCKETS


def pytest_unconfigure() -> None:
    """No socket of a test outlives the tests, nor does what they share."""
    shutil.rmtree(_SOCKETS, ignore_errors=True)
    if _OWN:
        shutil.rmtree(os.environ[SHARED], ignore_errors=True)


def pytest_report_header() -> str:
    """The class in which the tests were started, for whoever wonders about times."""
    return f"started in the scheduling class {_BEGAN}"


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """What is loaded stays: the garbage collector looks at it neither while it grows nor afterwards."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.set_threshold(
            20_000
        )  # with the usual 700 a tenth of the processor time of pages and rows is its looking
        gc.enable()


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
