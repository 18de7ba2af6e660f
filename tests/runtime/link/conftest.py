"""A lab, and a robot that is linked to it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.runtime.link.linked import STATION, Lab, Robot, allowed


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Lab]:
    """A busy machine loses no link by itself: silence is tested with clocks of the tests' own."""
    for name in ("line.LOST_S", "line._GREETED_S", "remote.LOST_S", "tokens.VALID_S", "gate._HELD_S"):
        monkeypatch.setattr(f"runtime.link.{name}", 60.0)
    made = Lab(tmp_path / "lab")
    yield made
    made.end()


@pytest.fixture
def robot(tmp_path: Path, lab: Lab) -> Iterator[Robot]:
    """Enrolled; not yet linked."""
    made = Robot(tmp_path / "robot", lab)
    lab.allowed.now = allowed((made.key, STATION))
    yield made
    made.end()


@pytest.fixture
def linked(robot: Robot, lab: Lab) -> Robot:
    """Linked."""
    robot.dial()
    lab.linked()
    return robot
