"""A station as other programs see it through its robot server, without one: at their own command."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np

from runtime.clients.robot_server.exchange import LatestObservation
from runtime.clients.robot_server.server import RobotServer
from runtime.clients.robot_server.session import SessionError

NAMES = ("arm.joint0", "arm.gripper")
DESCRIPTION: dict[str, Any] = {
    "protocol": 1,
    "station": "bench-7",
    "robot": "toy",
    "joint_names": list(NAMES),
    "units": ["rad", "opening, 0 to 1"],
    "lower": [-np.inf, 0.0],
    "upper": [np.inf, 1.0],
    "velocity": [2.0, 4.0],
    "home": [0.0, 1.0],
    "gripper_dims": [1],
    "rate": 100.0,
    "tasks": ["fold"],
    "moves_robot": True,
    "has_bench": True,
    "cameras": {"cam_high": [4, 6]},
    "state": "idle",
}


class ServedStation:
    """Session of a program that does at once what it is told; `over` ends it with that error."""

    def __init__(self) -> None:
        self.rows: list[list[float]] = []
        self.begun: list[dict[str, Any]] = []
        self.ends = 0
        self.closed = 0
        self.over: SessionError | None = None
        self.description: dict[str, Any] = dict(DESCRIPTION)
        self.url = ""

    def describe(self) -> Mapping[str, Any]:
        return self.description

    def begin(
        self, task: str, is_connected: Any, duration_s: Any = None, seed: Any = None, driver: str = "policy"
    ) -> Mapping[str, Any]:
        self.begun.append({"task": task, "seed": seed, "driver": driver})
        return {"episode": f"episode-{len(self.begun)}"}

    def observe(self) -> LatestObservation:
        self._refuse()
        joints = np.array(self.rows[-1] if self.rows else [0.0, 1.0], np.float32)
        step = len(self.rows)
        captured = {"joints": step + 0.25, "cam_high": step + 0.5}
        pictures = {"cam_high": np.full((4, 6, 3), step, np.uint8)}
        times = {"cam_high": captured["cam_high"]}
        return LatestObservation(0.0, step, joints, captured, "fold", joints, None, pictures, times)

    def act(self, row: np.ndarray) -> None:
        self._refuse()
        self.rows.append(row.tolist())

    def end(self) -> Mapping[str, Any]:
        self.ends += 1
        return {"episode": f"episode-{len(self.begun)}", "status": "finished"}

    def close(self, reason: str) -> None:
        self.closed += 1

    def _refuse(self) -> None:
        if self.over is not None:
            raise self.over


@contextmanager
def served() -> Iterator[ServedStation]:
    """A station behind a real robot server, at its `url`."""
    station = ServedStation()
    joints = {
        "measured": np.array([0.5, 0.5], np.float32),
        "commanded": np.array([np.nan, np.nan], np.float32),
    }
    server = RobotServer("token", lambda program: station, lambda: joints, 600.0)  # type: ignore[arg-type,return-value]
    station.url = f"ws://127.0.0.1:{server.open('127.0.0.1', 0)}/?token=token"
    try:
        yield station
    finally:
        server.close()
