"""A recorded episode on a robot, as the web sets it up: far from its start, approached, run, held and gone on with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import robots
from runtime.ipc.session_state import SessionState
from tests.runtime.lockstep_station import Station, stubbed
from tests.runtime.quality import built

ROWS = 90


@pytest.fixture
def station(tmp_path: Path) -> Station:
    return Station(stubbed(tmp_path, real="replay"))


def recorded(station: Station, root: Path) -> tuple[Path, np.ndarray]:
    """An episode that swings the first joint, beginning 0.4 rad from where the robot stands; its actions."""
    rest = np.asarray(station.robot.position, np.float32)

    def action(index: int) -> np.ndarray:
        row = rest.copy()
        row[0] += 0.4 + 0.1 * np.sin(index / 15)
        return row

    def swing(index: int, fields: dict[str, Any]) -> None:
        fields["action"] = action(index)

    name = station.coordinator.snapshot()["facts"]["robot"]
    assert name in robots.robot_names()
    folder = built.record_of(root / "told", name, swing, frames=ROWS)
    return folder, np.stack([action(index) for index in range(ROWS)])


def set_up(folder: Path) -> dict[str, Any]:
    """What evaweb.datasets.robot_replay asks for."""
    policy = {"kind": "replay", "path": str(folder), "episode": 0, "space": "joint", "horizon": 30}
    return {"policy": policy, "strategy": {"kind": "naive", "inference_rate": 5.0}}


@pytest.mark.exhaustive
def test_it_is_approached_then_run_and_goes_on_after_a_hold(station: Station, tmp_path: Path) -> None:
    folder, actions = recorded(station, tmp_path)
    station.ready(**set_up(folder))
    assert station.coordinator.snapshot()["first_action"]["far"]
    station.command("approach")
    station.reach(SessionState.READY)
    # The way is to the newest answer of the warm-up, which is a few rows on.
    assert station.robot.position[0] == pytest.approx(float(actions[0, 0]), abs=0.03)
    station.command("run", duration_s=ROWS / 30 + 1.0)
    station.go(30)
    station.command("halt")
    station.go(60)
    held = float(station.robot.position[0])
    station.command("resume")
    station.go(6)
    assert (
        abs(float(station.robot.position[0]) - held) < 0.05
    )  # it does not catch up with the time it was held
    station.until(lambda: station.state is SessionState.READY, 30.0, "the run ends by itself")
    assert station.robot.position[0] == pytest.approx(float(actions[-1, 0]), abs=0.01)
    station.close()
