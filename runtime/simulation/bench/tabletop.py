"""Simulated tabletop: blocks and a plate; the fingers of any arm push, grasp, carry and drop the blocks.

The simulation is deterministic: the same commands at the same times after the same reset have the same result. Only
fingers touch objects; the plate is fixed.
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

STEP = 1 / 120  # [s] longest step of the physics
REST_S = 0.2  # time without motion after which a block is at rest
LIFTED_M = 0.03  # height above the table from which a held block counts as lifted
MARGIN_M = 0.01  # least distance of the block's centre inside the plate's rim for success
_APART_SPEED = 0.5  # [m/s] speed at which overlapping objects separate
_WITHIN = 0.25  # [m] from fingertips to a block's centre; farther blocks cannot be touched
_RIM = 0.002  # [m] below the plate's top; a block that low is beside the plate


@dataclass(frozen=True, slots=True)
class ResetRequest:
    """Request for a new layout of the bench; `id` distinguishes new requests from repetitions."""

    id: str
    seed: int
    positions: Mapping[str, Any] | None = None


class Tabletop:
    """Objects on the bench of one robot; `advance` moves the robot's plant and everything that it touches.

    Time advances in steps of at most `step` [s].
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
        """Lay out the bench as requested; if `wish` has the id of the last reset, do nothing.

        Raises:
            BenchError: If the layout is not possible; nothing has changed then.
        """
        if wish.id == self._reset.id:
            return
        self._place_objects(wish)
        self._reset = wish

    def advance(self, plant: Plant, seconds: float) -> None:
        """Advance the plant and the bench by `seconds`; a held block limits how far the jaws close."""
        steps = math.ceil(seconds / self.step)
        for _ in range(steps):
            plant.advance(seconds / steps)
            self._step(plant.q, seconds / steps)

    def state(self) -> BenchState:
        """Return the state of everything on the table, for rendering."""
        x, y = self._plate
        return BenchState(tuple(block.state() for block in self._blocks), (float(x), float(y)))

    def truth(self) -> dict[str, object]:
        """Return the ground truth for the node's observation.

        Its milestones are those that the first block has reached since the last reset.
        """
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
        """Return the layout for a reset request.

        Raises:
            BenchError: If it is not possible; nothing has changed then.
        """
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
        """Apply the fingers of one arm to all blocks in this step, which lasts `seconds`.

        A block between the jaws stops the jaws. `q` [D] are the joints of the robot.
        """
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
        """Apply one arm's fingers to a block; return the opening [m] at which the block stops the jaws, else None."""
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
        """Return the height [m] of what supports a block's centre: the table, the plate or another block."""
        centre = block.pose[:2, 3]
        on_plate = float(np.hypot(*(centre - self._plate))) < self.bench.plate_radius
        heights = [self.bench.plate_height if on_plate else 0.0]
        for support in self._blocks:
            under = support is not block and not support.held_by and block.bottom > support.pose[2, 3]
            if under and np.abs(support.offset(centre)).max() < support.edge / 2:
                heights.append(support.top)
        return max(heights)

    def _separate(self, block: Block, neighbour: Block, seconds: float) -> None:
        """Slide a block away from another block that it overlaps, at a limited speed for `seconds`."""
        if block.held_by or abs(block.pose[2, 3] - neighbour.pose[2, 3]) > 0.9 * block.edge:
            return
        offset = block.pose[:2, 3] - neighbour.pose[:2, 3]
        distance = float(np.hypot(*offset))
        depth = 1.1 * block.edge - distance
        if depth > 0:
            direction = offset / distance if distance > 1e-9 else np.array([1.0, 0.0])
            block.shift(direction * min(depth, _APART_SPEED * seconds))

    def _clear_rim(self, block: Block, seconds: float) -> None:
        """Slide a block that stands on the table and touches the plate's rim away from the plate.

        It moves at a limited speed for `seconds`.
        """
        if block.bottom > self.bench.plate_height - _RIM:
            return
        offset = block.pose[:2, 3] - self._plate
        depth = self.bench.plate_radius - float(np.hypot(*(block.nearest(self._plate) - self._plate)))
        if depth > 0:
            block.shift(offset / max(float(np.hypot(*offset)), 1e-9) * min(depth, _APART_SPEED * seconds))

    def _note(self) -> None:
        """Update the milestones of the task's block."""
        block = self._blocks[0]
        lifted = bool(block.held_by) and block.bottom > LIFTED_M
        self._reached["grasped"] |= bool(block.held_by)
        self._reached["lifted"] |= lifted
        self._reached["over_plate"] |= lifted and self._from_plate() < self.bench.plate_radius

    def _from_plate(self) -> float:
        return float(np.hypot(*(self._blocks[0].pose[:2, 3] - self._plate)))

    def _on_plate(self, margin: float) -> bool:
        """Return True if the task's block is at rest on the plate, `margin` [m] inside its rim."""
        block = self._blocks[0]
        lies = block.still >= REST_S and abs(block.bottom - self.bench.plate_height) < 1e-3
        return lies and not block.held_by and self._from_plate() < self.bench.plate_radius - margin
