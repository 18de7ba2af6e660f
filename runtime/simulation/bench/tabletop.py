"""Simulated tabletop: blocks and discs; the fingers of any arm push, grasp, carry and drop the blocks.

The simulation is deterministic: the same commands at the same times after the same reset have the same result. Only
fingers touch objects; discs are fixed.
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING

import numpy as np

from runtime.core.types import Float64
from runtime.simulation.bench.bench import Bench
from runtime.simulation.bench.block import Block
from runtime.simulation.bench.block_table import BlockTable
from runtime.simulation.bench.grasp import RELEASE, push, squeeze
from runtime.simulation.bench.hands import Hand, Jaws
from runtime.simulation.bench.plant import Plant

if TYPE_CHECKING:
    from robots import Robot

STEP = 1 / 120  # [s] longest step of the physics
_APART_SPEED = 0.5  # [m/s] speed at which overlapping objects separate
_WITHIN = 0.25  # [m] from fingertips to a block's centre; farther blocks cannot be touched
_RIM = 0.002  # [m] below a disc's top; a block that low is beside the disc


class Tabletop(BlockTable):
    """Objects on the bench of one robot; `advance` moves the robot's plant and everything that it touches.

    Time advances in steps of at most `step` [s].
    """

    step = STEP

    def __init__(self, robot: Robot, seed: int, blocks: int = 1, bench: Bench | None = None) -> None:
        self._jaws = [Jaws(robot, arm) for arm in robot.arms if arm.gripper is not None]
        self._hands: dict[str, Hand] = {}
        super().__init__(seed, blocks, bench)

    def advance(self, plant: Plant, seconds: float) -> None:
        """Advance the plant and the bench by `seconds`; a held block limits how far the jaws close."""
        steps = math.ceil(seconds / self.step)
        for _ in range(steps):
            plant.advance(seconds / steps)
            self._step(plant.q, seconds / steps)

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
        """Return the height [m] of what supports a block's centre: the table, a disc or another block."""
        centre = block.pose[:2, 3]
        heights = [
            disc.height
            for disc, place in zip(self.bench.discs, self._discs, strict=True)
            if float(np.hypot(*(centre - place))) < disc.radius
        ] or [0.0]
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
        """Slide a block that stands on the table and touches a disc's rim away from the disc.

        It moves at a limited speed for `seconds`.
        """
        for disc, place in zip(self.bench.discs, self._discs, strict=True):
            if block.bottom > disc.height - _RIM:
                continue
            offset = block.pose[:2, 3] - place
            depth = disc.radius - float(np.hypot(*(block.nearest(place) - place)))
            if depth > 0:
                block.shift(offset / max(float(np.hypot(*offset)), 1e-9) * min(depth, _APART_SPEED * seconds))
