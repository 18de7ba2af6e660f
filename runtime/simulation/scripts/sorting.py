"""Scripted policy that sorts blocks by colour into bins, as the instruction says which colour goes into which bin.

It picks and places one block after the other as `pick_place` does, with the arm that is nearest. Its knowledge is the
overhead image, the joints and the instruction: "put the red blocks into the blue bin and the green blocks into the
purple bin". An instruction may name one colour alone, so that a part of the task can be asked for.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np

from runtime.core.types import Float32, Float64, UInt8
from runtime.simulation.bench.bench import Bench, Colour
from runtime.simulation.scripts.detection import BenchDetection, Detection
from runtime.simulation.scripts.pick_place import PickPlace, PickPlaceEpisode
from runtime.simulation.scripts.script import Answer

if TYPE_CHECKING:
    from robots import Robot
    from runtime.core.clock import Clock
    from runtime.simulation.scripts.pick_place import Apart, Skill

_SPOTS = 5  # places in a bin
_SPOT_RADIUS = 0.05  # [m] of the circle on which they lie
_ORDER = (0, 2, 4, 1, 3)  # so that neighbours are filled last
_TAKEN = 0.03  # [m] from a place to a block that takes it
_SAME = 0.03  # [m] by which a block may have moved and still be the same
_ALL = ("all", "every", "each", "the")  # words before "blocks" without a colour

Place = tuple[float, float]


class Sorting(PickPlace):
    """Sorting policy for all connections, for the objects of `table`.

    Blocks are called by the first word of their titles, and bins by theirs: "red block 1" is a red block.
    """

    def __init__(
        self,
        robot: Robot,
        horizon: int,
        rate: float,
        skill: Skill,
        table: Bench,
        name: str | None = None,
        clock: Clock | None = None,
        apart: Apart | None = None,
    ) -> None:
        super().__init__(robot, horizon, rate, skill, name or "sorting", clock, apart, table)
        boxes = table.schema.boxes.values()
        self.colours: Mapping[str, Colour] = {
            box.title.split()[0].lower(): table.colour(index) for index, box in enumerate(boxes)
        }
        self.bins: Mapping[str, str] = {disc.title.lower(): name for name, disc in table.schema.discs.items()}
        self.metadata = {
            **self.metadata,
            "description": "scripted sorting: sees the overhead picture, obeys the instruction, not a learned policy",
        }

    def begin(self) -> Answer:
        """Return the function that answers the requests of a new connection."""
        return SortingEpisode(self)

    def targets(self, prompt: str) -> dict[Colour, str]:
        """Return the bin of each colour that the instruction names; {} if it names none."""
        colours, bins = "|".join(map(re.escape, self.colours)), "|".join(map(re.escape, self.bins))
        found: dict[Colour, str] = {}
        for colour, name in re.findall(
            rf"\b(?:({colours})\s+|(?:{'|'.join(_ALL)})\s+)blocks?\b.*?\b({bins})\b", prompt.lower()
        ):
            for one in [colour] if colour else self.colours:
                found[self.colours[one]] = self.bins[name]
        return found


class SortingEpisode(PickPlaceEpisode):
    """State of one connection: the block that is moved now, and where the bins were seen last."""

    def __init__(self, policy: Sorting) -> None:
        super().__init__(policy)
        self._sorting = policy
        self._bins: dict[str, Place] = {}
        self._targets: dict[Colour, str] = {}

    def __call__(self, q: Float64, pictures: Mapping[str, UInt8], prompt: str) -> Float32:
        """Return rows float32 [H, D]: the next rows of the route, or the joints `q` if there is nothing to do."""
        self._targets = self._sorting.targets(prompt)
        return super().__call__(q, pictures, prompt)

    def _detect(self, pictures: Mapping[str, UInt8]) -> Detection:
        """Return the block to be moved and its place in a bin, as a block and a plate.

        While a route is followed, they are those of the route, as long as a block is detected where that one was.
        """
        found = self._sorting.overhead.detect_all(self._picture(pictures))
        self._bins |= found.discs
        if found.dark:
            return Detection(dark=True)
        waiting = list(self._waiting(found))
        if self._route is not None and self._seen.block is not None:
            seen = self._seen.block
            near = [block for block, _ in waiting if math.dist(block[:2], seen[:2]) < _SAME]
            return Detection(near[0] if near else None, self._seen.plate)
        if not waiting:
            return Detection()
        block, name = min(waiting, key=lambda one: (self._distance(one[0]), one[0]))
        return Detection(block, self._free_spot(self._bins[name], found))

    def _waiting(self, found: BenchDetection) -> Iterator[tuple[tuple[float, float, float], str]]:
        """Yield the blocks that are not in their bins, with the names of these."""
        radii = {disc.name: disc.radius for disc in self._sorting.table.discs}
        for colour, name in self._targets.items():
            if name not in self._bins:
                continue
            for block in found.blocks.get(colour, ()):
                if math.dist(block[:2], self._bins[name]) > radii[name]:
                    yield block, name

    def _distance(self, block: tuple[float, float, float]) -> float:
        """Return the horizontal distance of a block from the nearest arm's place [m]."""
        return min(math.dist(side, block[:2]) for side in self._sorting.table.schema.reach.sides)

    def _free_spot(self, bin_place: Place, found: BenchDetection) -> Place:
        """Return the first free place in a bin; the first of all if there is none."""
        blocks = [block[:2] for blocks in found.blocks.values() for block in blocks]
        spots = [
            (
                bin_place[0] + _SPOT_RADIUS * math.cos(angle),
                bin_place[1] + _SPOT_RADIUS * math.sin(angle),
            )
            for angle in np.array(_ORDER) * (2 * math.pi / _SPOTS) + math.pi / 2
        ]
        return next(
            (spot for spot in spots if all(math.dist(spot, block) > _TAKEN for block in blocks)), spots[0]
        )

    def _is_done(self, block: tuple[float, float, float], plate: Place) -> bool:
        """Return False: a block that is in its bin is not looked at again."""
        return False
