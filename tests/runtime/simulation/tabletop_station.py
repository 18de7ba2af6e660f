"""A station of any robot at its simulated tabletop in lockstep: node, bench and policy wire are the product's own.

Only time is virtual. Of the cameras the overhead one alone is drawn, three times a second; the others show nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np

import robots
from robots import Robot
from runtime.config import loader
from runtime.core.clock import VirtualClock
from runtime.core.types import Float64, UInt8
from runtime.ipc.session_state import SessionState
from runtime.processes.lockstep.lockstep import Lockstep
from runtime.simulation.bench.bench import Bench, camera_arm
from runtime.simulation.bench.block_table import BlockTable, ResetRequest
from runtime.simulation.bench.plant import Plant
from runtime.simulation.bench.tabletop import Tabletop
from runtime.simulation.environment import Environment
from runtime.simulation.node import parser
from runtime.simulation.render import Renderer
from runtime.simulation.scripts.pick_place import PickPlace, Skill, poses_apart
from runtime.simulation.scripts.pose_script import PoseScript
from runtime.simulation.scripts.script import Script
from runtime.standins.lockstep import in_process_peers
from runtime.standins.openpi_server import Behaviour, OpenpiServer
from runtime.station.checks import check_deployment
from runtime.station.spec import StationSpec

DEPLOYMENTS = Path(__file__).parents[3] / "deployments"
HORIZON = 50
_WIDTH, _HEIGHT = 640, 480
_EVERY = 10  # ticks between two drawn pictures
_SECONDS = 40.0
_NOISE = 0.001  # m


@cache
def renderer(robot: str) -> Renderer:
    """Draws the overhead camera's pictures."""
    made = robots.load_robot(robot)
    above = tuple(camera for camera in made.cameras if camera_arm(made, camera) is None)
    return Renderer(replace(made, cameras=above), Bench(), _WIDTH, _HEIGHT)


class SlowEye(Environment):
    """A tabletop whose overhead camera is slow."""

    def __init__(self, robot: Robot, table: BlockTable) -> None:
        self.table = table
        self._robot = robot
        self._dark = {camera.key: np.zeros((8, 8, 3), np.uint8) for camera in robot.cameras}
        self._shown: dict[str, UInt8] = {}

    def move(self, plant: Plant, seconds: float) -> None:
        self.table.advance(plant, seconds)

    def pictures(self, frame: int, seconds: float, q: Float64) -> dict[str, UInt8]:
        if not self._shown or frame % _EVERY == 0:
            self._shown = renderer(self._robot.name).draw(q, self.table.state())
        return {key: picture.copy() for key, picture in (self._dark | self._shown).items()}

    def truth(self) -> dict[str, object]:
        return self.table.truth()

    def reset(self, wish: ResetRequest) -> None:
        self.table.reset(wish)


@dataclass(frozen=True)
class Trial:
    """How a trial ended: what the bench says of it, the station's state and reason, its events, virtual seconds."""

    success: bool
    milestones: dict[str, bool]
    state: SessionState
    reason: str
    events: list[dict[str, Any]]
    seconds: float


class PolicyServer(Protocol):
    """A stand-in server of any protocol."""

    def start(self) -> dict[str, object]: ...

    def close(self) -> None: ...


Serve = Callable[[StationSpec, Script], PolicyServer]
"""Makes the server that plays a script, for a plan that does not know its address yet."""


def openpi_server(made: StationSpec, script: Script) -> PolicyServer:
    """What is served where nothing else is said."""
    return OpenpiServer(made.robot, Behaviour(HORIZON, made.rate, rtc="none"), 0, script)


def planned(name: str, data: Path, url: str | None, assignments: Sequence[str] = ()) -> StationSpec:
    """The station of the deployment `name`; nothing is recorded."""
    given = [f'data_dir="{data}"', "recording.enabled=false", "lockstep.delay_ticks=5", *assignments]
    given += [] if url is None else [f'policy.url="{url}"']
    return check_deployment(loader.load(DEPLOYMENTS / f"{name}.toml", given))


@contextmanager
def served(
    name: str,
    seed: int,
    data: Path,
    assignments: Sequence[str] = (),
    serve: Serve = openpi_server,
    make: Callable[[Robot, int], BlockTable] = Tabletop,
) -> Iterator[tuple[BlockTable, Lockstep]]:
    """A bench laid out by `seed`, and a station at it, not yet connected; its policy is served on its clock."""
    made, clock = planned(name, data, None, assignments), VirtualClock()
    bench = SlowEye(made.robot, make(made.robot, seed))
    options = parser().parse_args(["--robot", made.robot.name, "--bench", "tabletop"])
    policy: Any = made.deployment.policy  # of a kind that has these keys
    in_poses = policy.action_space == "eef"
    skill, apart = Skill(_NOISE, seed=seed), poses_apart if in_poses else None
    script = PickPlace(made.robot, HORIZON, made.rate, skill, clock=clock, apart=apart)
    spoken = PoseScript(script, made.robot, made.rate, policy.action_pose) if in_poses else script
    server = serve(made, spoken)
    url = str(server.start()["url"])
    with closing(server):
        made = planned(name, data, url, assignments)
        with closing(Lockstep(made, clock, peers=in_process_peers(made, clock, bench, options))) as station:
            yield bench.table, station


def pick_and_place(
    name: str,
    seed: int,
    data: Path,
    assignments: Sequence[str] = (),
    serve: Serve = openpi_server,
    make: Callable[[Robot, int], BlockTable] = Tabletop,
) -> Trial:
    """Set up, run until the block lies on the plate or for so long."""
    with served(name, seed, data, assignments, serve, make) as (table, station):
        session = station.coordinator.session
        station.connect()
        station.until(lambda: session.state is not SessionState.DISCONNECTED, 5.0, "first observation")
        station.command("setup")
        station.until(lambda: session.state is not SessionState.SETTING_UP, 60.0, "set-up")
        assert session.state is SessionState.READY, session.reason
        station.command("run")
        began = station.clock.now()

        def over() -> bool:
            late = station.clock.now() > began + _SECONDS
            return late or bool(table.truth()["success"]) or session.state is not SessionState.RUNNING

        station.until(over, 2 * _SECONDS, "the trial")
        truth = table.truth()
        reached = truth["milestones"]
        assert isinstance(reached, dict)
        return Trial(
            bool(truth["success"]),
            dict(reached),
            session.state,
            session.reason,
            station.coordinator.events.since(0),
            station.clock.now() - began,
        )
