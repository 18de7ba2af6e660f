"""What holds for every test: which stand no load beside them, who shares a lab, and that none is left real-time."""

from __future__ import annotations

import gc
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hypothesis
import pytest
from xdist.scheduler import LoadScopeScheduling

from runtime.core.environment import for_programs

_ALONE = [Path(__file__).parent / folder for folder in ("e2e", "crash")]  # whole labs, and what ends them
_OF_ONE_LAB = {  # fixtures of tests/e2e, and the files that use them: side by side each would start a lab of its own
    "patient": "story curves datasets debug_modes layout policy preflight replay_on_robot review",
    "shared": "faults stop_process lifetime",
}
_LABS = {f"tests/e2e/test_{name}.py": lab for lab, names in _OF_ONE_LAB.items() for name in names.split()}
os.environ |= for_programs(os.environ)
_BEGAN = os.sched_getscheduler(0)
hypothesis.settings.register_profile("eva", deadline=None)  # no test asserts timing: others share the machine
hypothesis.settings.load_profile("eva")
_SOCKETS = tempfile.mkdtemp(prefix="eva-")  # of every station that a test starts


class _Scheduling(LoadScopeScheduling):  # type: ignore[misc]
    """Whole files side by side; those of one lab after each other."""

    def _split_scope(self, nodeid: str) -> str:
        path = nodeid.partition("::")[0]
        return _LABS.get(path, path)

    def _assign_work_unit(self, node: Any) -> None:
        """The next file; where a process has died, what it had done is waiting too, and would keep `node` waiting."""
        while self.workqueue and all(next(iter(self.workqueue.values())).values()):
            self.workqueue.popitem(last=False)
        if self.workqueue:
            super()._assign_work_unit(node)
        else:
            node.shutdown()


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
    """No socket of a test outlives the tests."""
    shutil.rmtree(_SOCKETS, ignore_errors=True)


def pytest_report_header() -> str:
    """The class in which the tests were started, for whoever wonders about times."""
    return f"started in the scheduling class {_BEGAN}"


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Whether a file has none of the tests that `make test` asks for: ten thousand need not be made to be left out."""
    if config.option.markexpr == "not alone":
        return collection_path in _ALONE or None
    if config.option.markexpr != "alone" or not collection_path.match("test_*.py"):
        return None
    placed = any(folder in collection_path.parents for folder in _ALONE)
    return not (placed or b"mark.alone" in collection_path.read_bytes()) or None


@pytest.hookimpl(tryfirst=True)  # before -m chooses
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what `make test` does not run beside anything else."""
    for item in items:
        if any(folder in item.path.parents for folder in _ALONE):
            item.add_marker("alone")


@pytest.hookimpl(trylast=True)
def pytest_collection_finish() -> None:
    """What is loaded by now stays: the garbage collector does not look at it again and again."""
    gc.freeze()


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
