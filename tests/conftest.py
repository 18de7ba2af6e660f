"""What holds for every test: how many labs run at once, which files share one, and that none is left real-time."""

from __future__ import annotations

import gc
import os
import shutil
import tempfile
from collections.abc import Iterator
from typing import Any

import hypothesis
import pytest
from xdist.scheduler import LoadScopeScheduling

from runtime.core.environment import for_programs
from tests.migrated import SHARED

_LABS = (  # whole labs and stations in real time: so many of their files at once, beside all others
    "tests/e2e/",
    "tests/crash/",
    "tests/benchmarks/test_estop.py",
    "tests/runtime/sim/test_ros1_node.py",
    "tests/runtime/sim/test_ros2_node.py",
)
_AT_ONCE = max(2, os.cpu_count() or 1)
_GIVES_WAY = 2
_OF_ONE_LAB = {  # fixtures of tests/e2e, and the files that use them: side by side each would start a lab of its own
    "patient": "story curves datasets debug_modes failures find judging layout policy preflight replay_on_robot review "
    "scene_editor station_accessibility two_webs plan_wizard plan",
    "shared": "faults stop_process lifetime",
}
_SHARED = {f"tests/e2e/test_{name}.py": lab for lab, names in _OF_ONE_LAB.items() for name in names.split()}
os.environ |= for_programs(os.environ)
_BEGAN = os.sched_getscheduler(0)
hypothesis.settings.register_profile("eva", deadline=None)  # no test asserts timing: others share the machine
hypothesis.settings.load_profile("eva")
_SOCKETS = tempfile.mkdtemp(prefix="eva-")  # of every station that a test starts
_OWN = SHARED not in os.environ  # else that of the process that started this one
if _OWN:
    os.environ[SHARED] = tempfile.mkdtemp(prefix="eva-shared-")


class _Scheduling(LoadScopeScheduling):  # type: ignore[misc]
    """Whole files side by side, those of one lab after each other; a few workers go through the labs."""

    def _split_scope(self, nodeid: str) -> str:
        path = nodeid.partition("::")[0]
        return _SHARED.get(path, path)

    def _assign_work_unit(self, node: Any) -> None:
        """The next lab while fewer than `_AT_ONCE` others have one, the longest ones first; else the next other file.

        Where a process has died, what it had done is waiting too, and would keep `node` waiting.
        """
        for done in [scope for scope, tests in self.workqueue.items() if all(tests.values())]:
            del self.workqueue[done]
        labs = sorted(filter(_is_lab, self.workqueue), key=lambda scope: scope not in _OF_ONE_LAB)
        others = [scope for scope in self.workqueue if not _is_lab(scope)]
        busy = sum(
            any(_is_lab(scope) and not all(tests.values()) for scope, tests in units.items())
            for other, units in self.assigned_work.items()
            if other is not node
        )
        chosen = labs or others if busy < _AT_ONCE else others
        if not chosen:
            node.shutdown()
            return
        self.workqueue.move_to_end(chosen[0], last=False)
        super()._assign_work_unit(node)


def _is_lab(scope: str) -> bool:
    return scope in _OF_ONE_LAB or scope.startswith(_LABS)


@pytest.hookimpl(optionalhook=True)  # of xdist
def pytest_xdist_auto_num_workers() -> int:
    """Two more than there are cores: a third of the tests' time is waiting."""
    return (os.cpu_count() or 1) + 2


@pytest.hookimpl(optionalhook=True)  # of xdist
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> _Scheduling:
    """How tests are given to several processes."""
    return _Scheduling(config, log)


def pytest_configure() -> None:
    """Whatever started the tests, they are ordinary: else a busy one starves the real-time loops it looks at."""
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
        gc.enable()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """A worker that goes through no labs, or through no more, gives way to those: they wait in real time."""
    if "PYTEST_XDIST_WORKER" in os.environ and not _is_lab(item.nodeid) and os.nice(0) < _GIVES_WAY:
        os.nice(_GIVES_WAY - os.nice(0))


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
