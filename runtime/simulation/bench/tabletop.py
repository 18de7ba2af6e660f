"""The simulated tabletop: blocks and a plate that the fingers of any arm push, grasp, carry and drop.

The same commands at the same times from the same reset give the same course. Only fingers touch things; the
plate stays where it is.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from runtime.core.types import Float64
from runtime.simulation.bench.bench import (
    Bench,
    BenchLayout,
    BenchState,
    block_pose,
    yaw_of,
)
from runtime.simulation.bench.block import Block
from runtime.simulation.bench.grasp import RELEASE, push, squeeze
from runtime.simulation.bench.hands import Hand, Jaws
from runtime.simulation.bench.layout import draw_layout
from runtime.simulation.bench.plant import Plant

if TYPE_CHECKING:
    from robots import Robot

STEP = 1 / 120  # s, at most
REST_S = 0.2  # without moving, after which a block is at rest
LIFTED_M = 0.03  # between a held block and the table
MARGIN_M = 0.01  # inside the plate's rim that the block's centre must be
_APART_SPEED = 0.5  # m/s with which things that ended up in each other part
_WITHIN = 0.25  # m from fingertips to a block's centre, beyond which no part of a hand touches it
_RIM = 0.002  # m below the plate's top at which a block stands beside it


@dataclass(frozen=True, slots=True)
class ResetRequest:
    """A wish to lay the bench anew; `id` tells repetitions from new wishes."""

    id: str
    seed: int
    positions: Mapping[str, Any] | None = None


class Tabletop:
    """Things on the bench of one robot; `advance` moves the robot's plant and everything it touches.

    Time passes in pieces of at most `step` [s].
    """

    step = STEP

    def __init__(self, robot: Robot, seed: int, blocks: int = 1, bench: Bench | None = None) -> None:
        self.bench = bench or Bench()
        self._count = blocks
        self._jaws = [Jaws(robot, arm) for arm in robot.arms if arm.gripper is not None]
        self._hands: dict[str, Hand] = {}
        self._blocks: list[Block] = []
        self._plate = np.zeros(2)
        self._reached: dict[str, bool] = {}
        self._reset = ResetRequest("", seed)
        self._place_objects(self._reset)

    def reset(self, wish: ResetRequest) -> None:
        """Lay the bench as wished; the same `id` again changes nothing. BenchError where that cannot be."""
        if wish.id == self._reset.id:
            return
        self._place_objects(wish)
        self._reset = wish

    def advance(self, plant: Plant, seconds: float) -> None:
        """Let time pass for the plant and the bench together; what is held keeps the jaws open."""
        steps = math.ceil(seconds / self.step)
        for _ in range(steps):
            plant.advance(seconds / steps)
            self._step(plant.q, seconds / steps)

    def state(self) -> BenchState:
        """Everything on the table, for pictures."""
        x, y = self._plate
        return BenchState(tuple(block.state() for block in self._blocks), (float(x), float(y)))

    def truth(self) -> dict[str, object]:
        """The node's report of its bench; milestones are those of the first block since the last reset."""
        placed = self._on_plate(0.0)
        return {
            "reset": self._reset.id,
            "seed": self._reset.seed,
            "blocks": [[*map(float, block.pose[:3, 3]), yaw_of(block.pose)] for block in self._blocks],
            "plate": [float(part) for part in self._plate],
            "held": [block.held_by for block in self._blocks],
            "milestones": {**self._reached, "placed": placed},
            "success": self._on_plate(MARGIN_M),
        }

    def _layout(self, wish: ResetRequest) -> BenchLayout:
        """Layout for a reset; BenchError where it cannot be, and then nothing has changed."""
        return draw_layout(wish.seed, wish.positions, self._count)

    def _place_objects(self, wish: ResetRequest) -> None:
        layout = self._layout(wish)
        edge = self.bench.block_edge
        self._blocks = [Block(block_pose(place, self.bench), edge) for place in layout.blocks]
        self._plate = np.array(layout.plate)
        self._reached = {"grasped": False, "lifted": False, "over_plate": False}

    def _step(self, q: Float64, seconds: float) -> None:
        for jaws in self._jaws:
            self._handle(jaws, q, seconds)
        for first, second in itertools.permutations(self._blocks, 2):
            self._separate(first, second, seconds)
        for block in self._blocks:
            if not block.held_by:
                self._clear_rim(block, seconds)
                block.fall(self._support(block), seconds)
            block.update_rest(seconds)
        self._note()

    def _handle(self, jaws: Jaws, q: Float64, seconds: float) -> None:
        """Apply one arm's fingers to every block within this step."""
        before = self._hands.get(jaws.name)
        hand = jaws.hand(q, before, seconds)
        stops = [
            self._touch(hand, before or hand, block, seconds)
            for block in self._blocks
            if block.held_by or math.dist(hand.tip[:3, 3], block.pose[:3, 3]) < _WITHIN
        ]
        opening = max((stop for stop in stops if stop is not None), default=0.0)
        if hand.opening < opening:
            jaws.stop(q, opening)
            hand = jaws.hand(q, before, seconds)
        self._hands[jaws.name] = hand

    def _touch(self, hand: Hand, before: Hand, block: Block, seconds: float) -> float | None:
        """The opening at which the block stops the jaws, if it does."""
        if block.held_by not in ("", hand.arm):
            return None
        if block.held_by and hand.opening > block.edge + RELEASE:
            block.release()
        if not block.held_by:
            width = squeeze(hand, before, block)
            if width is None:
                push(hand, block, seconds)
                return None
            if not block.held_by:
                return width
        block.carry(hand.tip, self._support(block))
        return block.edge

    def _support(self, block: Block) -> float:
        """The height of what is under a block's centre: the table, the plate or another block."""
        centre = block.pose[:2, 3]
        on_plate = float(np.hypot(*(centre - self._plate))) < self.bench.plate_radius
        heights = [self.bench.plate_height if on_plate else 0.0]
        for other in self._blocks:
            under = other is not block and not other.held_by and block.bottom > other.pose[2, 3]
            if under and np.abs(other.offset(centre)).max() < other.edge / 2:
                heights.append(other.top)
        return max(heights)

    def _separate(self, block: Block, other: Block, seconds: float) -> None:
        """Slide a block out of another one beside it."""
        if block.held_by or abs(block.pose[2, 3] - other.pose[2, 3]) > 0.9 * block.edge:
            return
        way = block.pose[:2, 3] - other.pose[:2, 3]
        distance = float(np.hypot(*way))
        depth = 1.1 * block.edge - distance
        if depth > 0:
            direction = way / distance if distance > 1e-9 else np.array([1.0, 0.0])
            block.shift(direction * min(depth, _APART_SPEED * seconds))

    def _clear_rim(self, block: Block, seconds: float) -> None:
        """Slide a block that stands beside the plate out of its rim."""
        if block.bottom > self.bench.plate_height - _RIM:
            return
        way = block.pose[:2, 3] - self._plate
        depth = self.bench.plate_radius - float(np.hypot(*(block.nearest(self._plate) - self._plate)))
        if depth > 0:
            block.shift(way / max(float(np.hypot(*way)), 1e-9) * min(depth, _APART_SPEED * seconds))

    def _note(self) -> None:
        """Remember how far the task's block has come."""
        block = self._blocks[0]
        lifted = bool(block.held_by) and block.bottom > LIFTED_M
        self._reached["grasped"] |= bool(block.held_by)
        self._reached["lifted"] |= lifted
        self._reached["over_plate"] |= lifted and self._from_plate() < self.bench.plate_radius

    def _from_plate(self) -> float:
        return float(np.hypot(*(self._blocks[0].pose[:2, 3] - self._plate)))

    def _on_plate(self, margin: float) -> bool:
        """True if the task's block lies on the plate at rest, `margin` [m] inside its rim."""
        block = self._blocks[0]
        lies = block.still >= REST_S and abs(block.bottom - self.bench.plate_height) < 1e-3
        return lies and not block.held_by and self._from_plate() < self.bench.plate_radius - margin
