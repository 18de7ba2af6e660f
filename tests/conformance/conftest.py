from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from runtime.simulation.ros.ros_domain import free_domain
from tests.processes import joined
from tests.runtime.ros_master import RosMaster, master


@pytest.fixture
def no_thread_is_left() -> Iterator[None]:
    """Whatever a test begins has ended soon after it."""
    before = set(threading.enumerate())
    yield
    for thread in set(threading.enumerate()) - before:
        joined(thread)


@pytest.fixture
def domain() -> Iterator[int]:
    """A ROS domain of the test's own."""
    with free_domain() as number:
        yield number


@pytest.fixture(scope="module")
def ros_master(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RosMaster]:
    """A ROS master for the tests of one module."""
    with master(tmp_path_factory.mktemp("ros")) as made:
        yield made
