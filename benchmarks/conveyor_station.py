"""Station in lockstep at the simulated conveyor: node, transport and policy are in this process, without sockets."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import robots
from robots import Robot
from runtime.config import loader
from runtime.core.clock import VirtualClock
from runtime.core.types import ActionChunk, Conditioning, Float64, Observation, UInt8
from runtime.policies.base import Policy, PolicyInfo
from runtime.processes.lockstep.lockstep import Lockstep
from runtime.simulation.bench.bench import BenchState, camera_arm
from runtime.simulation.bench.block_table import ResetRequest
from runtime.simulation.bench.conveyor import CONVEYOR, Conveyor
from runtime.simulation.bench.plant import Plant
from runtime.simulation.environment import Environment
from runtime.simulation.node import parser
from runtime.simulation.render import Renderer
from runtime.simulation.scripts.chase import ChaseScript, PlaceMap
from runtime.standins.continuing import CommittedPrefix, continue_prefix
from runtime.standins.lockstep import in_process_peers
from runtime.station.checks import check_deployment

HORIZON = 50  # rows of a chunk
_WIDTH, _HEIGHT = 320, 240
_KEPT = 4  # frames whose image can still be rendered


@cache
def _renderer(robot: str) -> Renderer:
    """Return the renderer of the overhead camera, shared by all stations of this process."""
    loaded = robots.load_robot(robot)
    above = tuple(camera for camera in loaded.cameras if camera_arm(loaded, camera) is None)
    return Renderer(replace(loaded, cameras=above), CONVEYOR, _WIDTH, _HEIGHT)


@cache
def _places(robot: str) -> PlaceMap:
    """Return the map from positions of the belt to a robot's joints, shared by all stations of this process."""
    assert CONVEYOR.belt is not None
    return PlaceMap(robots.load_robot(robot), CONVEYOR.belt)


class DeferredPicturesEnvironment(Environment):
    """Conveyor environment whose images contain only the frame number; `render` draws the image of a frame on
    demand.
    """

    def __init__(self, robot: Robot, conveyor: Conveyor) -> None:
        self.conveyor = conveyor
        self._keys = tuple(camera.key for camera in robot.cameras)
        self._renderer = _renderer(robot.name)
        self._frames: OrderedDict[int, tuple[Float64, BenchState]] = OrderedDict()

    def move(self, plant: Plant, seconds: float) -> None:
        """Advance the plant, and the objects that its fingers touch."""
        self.conveyor.advance(plant, seconds)

    def pictures(self, frame: int, seconds: float, q: Float64) -> dict[str, UInt8]:
        """Return for each camera an image with only the frame number, uint8 [4, 4, 3]."""
        self._frames[frame] = q.copy(), self.conveyor.state()
        if len(self._frames) > _KEPT:
            self._frames.popitem(last=False)
        digits = np.frombuffer(frame.to_bytes(4, "big"), np.uint8)
        return {key: np.broadcast_to(digits[:, None, None], (4, 4, 3)).copy() for key in self._keys}

    def render(self, stamp: UInt8) -> dict[str, UInt8]:
        """Return the images of one frame by camera key, RGB uint8 [H, W, 3]; the only camera is the overhead camera.

        `stamp` is a small image that encodes the number of the frame.
        """
        q, state = self._frames[int.from_bytes(stamp[:, 0, 0].tobytes(), "big")]
        drawn = self._renderer.draw(q, state)
        return {key: np.ascontiguousarray(bgr[..., ::-1]) for key, bgr in drawn.items()}

    def truth(self) -> dict[str, object]:
        """Return the ground truth of the belt's motion, and of the tracking."""
        return self.conveyor.truth()

    def reset(self, wish: ResetRequest) -> None:
        """Reset the conveyor with another motion of the belt."""
        self.conveyor.reset(wish)


class ScriptPolicy(Policy):
    """Policy in this process that answers with the rows of a script, for rendered images."""

    def __init__(self, script: ChaseScript, gallery: DeferredPicturesEnvironment) -> None:
        self._script, self._gallery = script, gallery
        self._answer = script.begin()

    def connect(self) -> PolicyInfo:
        """Return the policy's properties; there is no server."""
        return PolicyInfo("chase", action_space="joint", horizon=HORIZON, supports_rtc=True)

    def infer(self, observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
        """Return the script's rows for this observation, after the committed rows of the conditioning."""
        pictures = self._gallery.render(observation.pictures[self._script.overhead.key])
        rows = self._answer(observation.qpos.astype(np.float64), pictures, observation.prompt)
        if conditioning is not None:
            left = conditioning.remaining_rows.astype(np.float64)
            rows = continue_prefix(rows, CommittedPrefix(left, conditioning.predicted_delay, len(left)))
        return ActionChunk(rows)

    def reset(self) -> None:
        """Restart the script."""
        self._answer = self._script.begin()

    def close(self) -> None:
        """Do nothing, because there are no resources."""


def station_at(data: Path, strategy: Mapping[str, Any], delay: int, seed: int) -> tuple[Conveyor, Lockstep]:
    """Return a conveyor, and a station in lockstep whose robot is at this conveyor.

    `seed` decides the motion of the belt. The station records nothing.
    """
    tree: dict[str, Any] = {
        "station": "conveyor",
        "robot": "agilex_piper",
        "data_dir": str(data),
        "task": "stay beside the block",
        "transport": {"kind": "zmq", "simulated": True, "detect_frozen": False},
        "policy": {"kind": "mock"},
        "strategy": dict(strategy),
        "setup": {"pose": "ready"},
        "recording": {"enabled": False},
        "lockstep": {"delay_ticks": delay},
    }
    station_spec = check_deployment(loader.resolve_deployment(tree, {}, "moving_target"))
    gallery = DeferredPicturesEnvironment(station_spec.robot, Conveyor(station_spec.robot, seed))
    clock = VirtualClock()
    options = parser().parse_args(
        ["--robot", station_spec.robot.name, "--bench", "conveyor", "--start-pose", "ready"]
    )
    script = ChaseScript(
        station_spec.robot, HORIZON, station_spec.rate, clock=clock, places=_places(station_spec.robot.name)
    )
    peers = replace(
        in_process_peers(station_spec, clock, gallery, options),
        policy=lambda spec, clock: ScriptPolicy(script, gallery),
    )
    return gallery.conveyor, Lockstep(station_spec, clock, peers=peers)
