from __future__ import annotations

from collections.abc import Iterator

import pytest

from runtime.simulation.ros.ros_domain import free_domain
from tests.runtime.ros_master import RosMaster, master


@pytest.fixture
def domain() -> Iterator[int]:
    """A ROS domain of the test's own."""
    with free_domain() as number:
        yield number


@pytest.fixture(scope="module")
def ros_master(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RosMaster]:
    """A ROS master for the tests of one module, which leave it as they found it."""
    with master(tmp_path_factory.mktemp("ros")) as made:
        yield made
