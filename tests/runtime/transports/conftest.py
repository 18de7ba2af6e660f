from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.runtime.ros_domain import free_domain


@pytest.fixture
def domain() -> Iterator[int]:
    """A ROS domain of the test's own."""
    with free_domain() as number:
        yield number
