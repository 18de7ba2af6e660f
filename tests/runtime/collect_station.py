"""A lockstep station that collects: a leader in the test's hand, or a robot that drives itself when it is told to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from runtime.config import loader
from runtime.core.clock import Clock
from runtime.core.errors import PolicyLostError
from runtime.core.types import Float64, Observation
from runtime.processes.coordinator.builders import make_policy
from runtime.processes.lockstep.lockstep import Peers
from runtime.station.checks import check_deployment
from runtime.station.spec import StationSpec
from runtime.teleoperators.base import Leader
from runtime.transports.base import Capabilities
from tests.runtime.lockstep_station import MOVED, STANDS, Station, StubRobot, Stubs, stubbed


class HeldLeader(Leader):
    """Is where the test put it; `silent` says nothing any more."""

    def __init__(self, robot: Any, clock: Clock) -> None:
        super().__init__(robot, clock)
        self.joints: Float64 | None = STANDS.copy()
        self.silent = False
        self.connected = 0

    @property
    def name(self) -> str:
        return "the leader in the test"

    def connect(self) -> None:
        self.connected += 1
        self._forget()
        if self.joints is None:
            raise PolicyLostError(f"{self.name} says nothing")
        self.speak()

    def close(self) -> None:
        pass

    def speak(self) -> None:
        """Say where it is."""
        if not self.silent and self.joints is not None:
            self._set_pose(self.joints.copy(), self._clock.now())


class SelfDriven(StubRobot):
    """A robot whose node drives it while it collects, and reports what it applied."""

    collects = False
    leaderless = False
    words: list[str]

    def receive(self, timeout: float) -> Observation | None:
        if self.collects:
            self.position[list(MOVED)] += 0.002
        seen = super().receive(timeout)
        if seen is None or not self.collects or self.leaderless:
            return seen
        return replace(seen, reported_action=(self.position + 0.01).astype(np.float32))

    def send_control_word(self, word: str, data: Mapping[str, Any]) -> None:
        self.told.append((word, dict(data)))
        self.collects = word == "collect_start"


@dataclass
class CollectStubs(Stubs):
    """Those of a station whose leader, or whose self-driven robot, is the test's."""

    mute: bool = False  # the leader says nothing

    def __post_init__(self) -> None:
        self.spec = replace(self.spec, capabilities=Capabilities(moves_robot=True, drives_itself=True))

    @property
    def peers(self) -> Peers:
        policy = partial(make_policy, build=self.policy, leader=self.leader)
        return Peers(self.robot, self.robot, policy)

    def leader(self, spec: StationSpec, clock: Clock) -> HeldLeader:
        self.built["leader"] = leader = HeldLeader(spec.robot, clock)
        if self.mute:
            leader.joints = None
        return leader

    def robot(self, spec: StationSpec, clock: Clock) -> StubRobot:
        if spec.deployment.collection is not None and spec.deployment.collection.source == "node":
            self.built.setdefault("robot", SelfDriven(self, clock))
        return super().robot(spec, clock)


class CollectStation(Station):
    """Moves its leader, which speaks once per tick, by `turn` per tick on two joints."""

    def __init__(self, stubs: CollectStubs) -> None:
        super().__init__(stubs)
        self.turn = 0.0

    @property
    def leader(self) -> HeldLeader:
        made: HeldLeader = self.stubs.built["leader"]
        return made

    def tick(self) -> None:
        if "leader" in self.stubs.built and self.leader.joints is not None:
            self.leader.joints[list(MOVED)] += self.turn
            self.leader.speak()
        super().tick()

    @property
    def collect(self) -> Any:
        return self.coordinator.snapshot()["collect"]

    def armed(self, **arguments: Any) -> CollectStation:
        self.ready(collect=True, **arguments)
        self.command("arm")
        return self


def collecting(data: Path, source: str = "relay", **changes: Any) -> CollectStation:
    """A station with a [collection] of that source; `changes` are keys of it, or other tables by their name."""
    tables = {
        name: changes.pop(name) for name in ("safety", "recording", "setup", "faults") if name in changes
    }
    leader = {"leader": {"kind": "zmq"}} if source == "relay" else {}
    on_top: dict[str, Any] = {"collection": {"source": source, **leader, **changes}}
    if source == "node":  # a recording drives no robot, and its deployment is refused
        on_top["transport"] = {"kind": "zmq"}
    resolved = loader.apply_changes(stubbed(data, **tables).spec.resolved, on_top, "test")
    return CollectStation(CollectStubs(check_deployment(resolved)))
