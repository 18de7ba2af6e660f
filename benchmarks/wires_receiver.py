"""Receiving side of a transport in a process, like reception: `python -m benchmarks.wires_receiver JSON`.

The JSON is a `Receiving`. Observations are written to the shared state whose descriptor is inherited, until standard
input ends. With `fast`, for recordings, a virtual clock advances by a frame as soon as the previous frame is written,
and a finished recording is played again.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import robots
from robots import Robot
from runtime.cameras.attach import attach_cameras
from runtime.core import process_limits as heap
from runtime.core.clock import Clock, MonotonicClock, VirtualClock
from runtime.core.plugins import variants
from runtime.core.types import Observation
from runtime.ipc.messages import Event
from runtime.ipc.shared_state import SharedState, SharedStateLayout
from runtime.processes.reception.receiver import ObservationReceiver
from runtime.transports.base import Source

FPS = 30.0
_PUMP_S = 0.005  # as in reception


@dataclass(frozen=True, slots=True)
class Receiving:
    """Parameters of the receiving side: robot, transport and cameras, descriptor of the shared state, and `fast`.

    The robot is a name or path; transport and cameras are as in a deployment.
    """

    robot: str
    transport: Mapping[str, Any]
    shared: int
    cameras: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    fast: bool = False

    def text(self) -> str:
        return json.dumps(asdict(self))


def layout(robot: Robot) -> SharedStateLayout:
    """Return the layout of shared state for a station with this robot and all its cameras."""
    return SharedStateLayout(robot.dim, robot.eef_dim, tuple(camera.key for camera in robot.cameras))


def source(given: Receiving, robot: Robot, clock: Clock) -> Source:
    """Return the transport's observations, with the pictures of the deployment's own cameras added."""
    module = variants("runtime.transports")[given.transport["kind"]]
    kinds = variants("runtime.cameras")
    cameras = {key: kinds[table["kind"]].Config(**table) for key, table in given.cameras.items()}
    reduced = replace(robot, cameras=tuple(camera for camera in robot.cameras if camera.key not in cameras))
    return attach_cameras(module.source(module.Config(**given.transport), reduced, clock), cameras, clock)


def main(text: str) -> None:
    """Receive observations until the lifeline ends, then print the counts of faults as JSON.

    `text` is the JSON text of the fields of `Receiving`.
    """
    heap.keep_freed_memory()
    settings = Receiving(**json.loads(text))
    robot = robots.load_robot(settings.robot)
    clock = VirtualClock() if settings.fast else MonotonicClock()
    player = _Player()
    shared = SharedState.attach(layout(robot), settings.shared)
    with contextlib.closing(source(settings, robot, clock)) as opened:
        intake = ObservationReceiver(
            shared, opened, clock, _say, lambda observation, numbers: player.receive(observation)
        )
        opened.connect()
        opened.begin_run()
        while not select.select([sys.stdin], [], [], 0.0)[0]:
            intake.poll(0.0 if settings.fast else _PUMP_S)
            if isinstance(clock, VirtualClock):
                clock.advance(1.0 / FPS)
            if player.over:
                player.over = False
                opened.begin_run()
        print(json.dumps(opened.faults()), flush=True)


class _Player:
    """Receiver of observations that sets `over` once the recording has ended."""

    def __init__(self) -> None:
        self.over = False

    def receive(self, observation: Observation) -> None:
        self.over = self.over or observation.last


def _say(event: Event) -> None:
    print(event.text, file=sys.stderr)


if __name__ == "__main__":
    main(sys.argv[1])
    sys.stdout.flush()
    os._exit(0)  # nothing is left to close, and threads of a middleware must not delay the exit
