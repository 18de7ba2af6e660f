"""A policy on the simulated bench in virtual time: plant, tabletop, renderer, async execution, safety."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np

import robots
from robots import Robot
from runtime.benches.schema import load_schema
from runtime.core.clock import VirtualClock
from runtime.core.types import Float64, UInt8
from runtime.motion.timeline import DimensionKinds, Timeline
from runtime.policies.pictures import resize_image, to_layout
from runtime.safety.filter import Limits, RobotState, SafetyFilter, SafetySettings
from runtime.simulation.bench.bench import Bench
from runtime.simulation.bench.block_table import BlockTable, ResetRequest
from runtime.simulation.bench.plant import Plant
from runtime.simulation.bench.tabletop import Tabletop
from runtime.simulation.render import Renderer
from runtime.simulation.scripts.pick_place import PickPlace, Skill
from runtime.simulation.scripts.script import Answer
from runtime.simulation.scripts.sorting import Sorting
from runtime.strategies import overlap
from runtime.strategies.base import ArrivedChunk

ROBOT = robots.load_robot("agilex_piper")
RATE = 30.0
CAMERA = "cam_high"
_GRIPPERS = np.isin(np.arange(ROBOT.dim), ROBOT.gripper_dims)
_LIMITS = Limits(
    ROBOT.joint_names, ROBOT.lower, ROBOT.upper, ROBOT.velocity, _GRIPPERS, np.zeros(ROBOT.dim, bool)
)


@cache
def renderer(bench: str = "tabletop") -> Renderer:
    seeing = replace(ROBOT, cameras=tuple(camera for camera in ROBOT.cameras if camera.key == CAMERA))
    return Renderer(seeing, Bench(load_schema(bench)), 640, 480)


@dataclass(frozen=True)
class Outcome:
    """`success` and `milestones` as the bench tells them, `seconds` it took, what safety had to say."""

    success: bool
    seconds: float
    milestones: dict[str, bool]
    notes: tuple[str, ...]
    sent: Float64


class Trial:
    """One policy server and one bench; every `run` is another connection, unless it goes on with the last."""

    def __init__(
        self,
        skill: Skill,
        delay: int = 6,
        pose: str = "ready",
        make: Callable[[Robot, int], BlockTable] = Tabletop,
        prompt: str = "put the block on the plate",
        bench: str = "tabletop",
    ) -> None:
        self.clock = VirtualClock()
        self.prompt, self.bench = prompt, bench
        self.policy = (
            PickPlace(ROBOT, 50, RATE, skill, clock=self.clock)
            if bench == "tabletop"
            else Sorting(ROBOT, 50, RATE, skill, Bench(load_schema(bench)), clock=self.clock)
        )
        self.delay = delay
        self.pose = pose
        self.plant = Plant(ROBOT)
        self.table = make(ROBOT, 0)
        self.answer: Answer = self.policy.begin()
        self.dark = False
        self._number = 0

    def lay(self, seed: int) -> Trial:
        """Another scene, the arms back where they start; the connection stays."""
        self._number += 1
        self.table.reset(ResetRequest(str(self._number), seed))
        self.plant.q = ROBOT.poses[self.pose].copy()
        self.plant.target = self.plant.q.copy()
        self.clock.advance(5.0)
        return self

    def shove(self, x: float, y: float) -> None:
        """Somebody moves the block by that much."""
        self.table._blocks[0].shift(np.array([x, y]))

    def put(self, x: float, y: float, z: float) -> None:
        """Somebody puts the block there, with its bottom at z."""
        block = self.table._blocks[0]
        block.pose[:3, 3] = x, y, z + block.edge / 2

    def picture(self) -> UInt8:
        """What the policy is sent: 224 by 224, letterboxed, channels first, RGB."""
        shown = renderer(self.bench).draw(self.plant.q, self.table.state())[CAMERA]
        whole = (
            np.zeros_like(shown)
            if self.dark
            else np.asarray(cv2.cvtColor(shown, cv2.COLOR_BGR2RGB), np.uint8)
        )
        return to_layout(resize_image(whole, 224, 224, "pad"), "chw")

    def ask(self) -> Float64:
        """The rows for this moment."""
        q = self.plant.q.astype(np.float32).astype(np.float64)
        return self.answer(q, {CAMERA: self.picture()}, self.prompt).astype(np.float64)

    def run(self, seconds: float = 30.0, to_the_end: bool = False) -> Outcome:
        """Ask back to back, every answer `delay` ticks late, until success or for so long."""
        timeline, merge = Timeline(ROBOT.dim), overlap.merge(overlap.Config(), DimensionKinds())
        safety = SafetyFilter(SafetySettings(), _LIMITS)
        previous, velocity = self.plant.target.copy(), np.zeros(ROBOT.dim)
        notes: list[str] = []
        sent: list[Float64] = []
        asked, rows = 0, self.ask()
        step = 0
        while step < seconds * RATE:
            if step - asked >= self.delay:
                merge(timeline, ArrivedChunk(step, asked, rows), step)
                asked, rows = step, self.ask()
            planned = timeline.at(step)
            if planned is not None:
                state = RobotState(previous, velocity, self.plant.q, 1 / RATE)
                verdict = safety.judge(planned.action, state)
                notes.extend(verdict.notes)
                if verdict.action is not None:
                    velocity, previous = (verdict.action - previous) * RATE, verdict.action
                    self.plant.target = verdict.action
                    sent.append(verdict.action)
            self.table.advance(self.plant, 1 / RATE)
            self.clock.advance(1 / RATE)
            step += 1
            if self.table.truth()["success"] and not to_the_end:
                break
        truth = self.table.truth()
        reached = truth["milestones"]
        assert isinstance(reached, dict)
        return Outcome(bool(truth["success"]), step / RATE, dict(reached), tuple(notes), np.array(sent))
