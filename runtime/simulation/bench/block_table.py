"""Blocks and discs on the simulated bench: their layout, the milestones of the task and the ground truth.

Subclasses decide how blocks move: by rules (`tabletop.py`) or by contact forces (`runtime/simulation/contact`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from runtime.benches.schema import Milestone
from runtime.simulation.bench.bench import Bench, BenchError, BenchLayout, BenchState, block_pose, yaw_of
from runtime.simulation.bench.block import Block
from runtime.simulation.bench.layout import draw_layout
from runtime.simulation.bench.plant import Plant

REST_S = 0.2  # time without motion after which a block is at rest
LIFTED_M = 0.03  # height above the table from which a held block counts as lifted
MARGIN_M = 0.01  # least distance of a block's centre inside a disc's rim for success
_USUAL = (1.0, 0.0)  # size and hue of blocks that look as the schema says


@dataclass(frozen=True, slots=True)
class ResetRequest:
    """Request for a new layout of the bench; `id` distinguishes new requests from repetitions."""

    id: str
    seed: int
    positions: Mapping[str, Any] | None = None
    factors: Mapping[str, Any] | None = None
    choices: Mapping[str, Any] | None = None


class BlockTable(ABC):
    """Blocks and discs in front of one robot; `advance` moves the robot's plant and everything that it touches."""

    unsimulated: frozenset[str] = frozenset(("friction", "mass"))
    """Factors that have no effect here, and are refused."""

    def __init__(self, seed: int, blocks: int = 1, bench: Bench | None = None) -> None:
        self.bench = bench or Bench()
        self._count = blocks
        self._blocks: list[Block] = []
        self._discs = np.zeros((len(self.bench.discs), 2))
        self._reached: dict[str, bool] = {}
        self._factors: dict[str, float] = {}
        self._reset = ResetRequest("", seed)
        self._place_objects(self._reset)

    @abstractmethod
    def advance(self, plant: Plant, seconds: float) -> None:
        """Advance the plant and the bench by `seconds`; a held block limits how far the jaws close."""

    def reset(self, wish: ResetRequest) -> None:
        """Lay out the bench as requested; if `wish` has the id of the last reset, do nothing.

        Raises:
            BenchError: If the layout is not possible; nothing has changed then.
        """
        if wish.id == self._reset.id:
            return
        self._place_objects(wish)
        self._reset = wish

    def state(self) -> BenchState:
        """Return the state of everything on the table, for rendering."""
        discs = tuple((float(x), float(y)) for x, y in self._discs)
        x, y, z = (self._factors.get(f"camera_{axis}", 0.0) for axis in "xyz")
        blocks = tuple(block.state() for block in self._blocks)
        return BenchState(blocks, discs, self._factors.get("light", 1.0), (x, y, z), *self._appearance)

    @property
    def _appearance(self) -> tuple[float, float]:
        """Size of the blocks, as a multiple of the usual one, and turn of their hue [degrees]."""
        return self._factors.get("size", 1.0), self._factors.get("hue", 0.0)

    @property
    def _varied(self) -> Bench:
        """The bench with its present sizes and colours."""
        return self.bench.varied(*self._appearance)

    def truth(self) -> dict[str, object]:
        """Return the ground truth for the node's observation.

        Milestones that pass are those that were reached since the last reset. `plate` is the first disc. Where blocks
        do not look as usual, `edges` [m] and `colours` (0 to 255) say how.
        """
        schema = self.bench.schema
        reached = {
            name: self._reached[name] if milestone.passes else self._rests(milestone)
            for name, milestone in schema.milestones.items()
        }
        discs = self._discs.tolist()
        return {
            "reset": self._reset.id,
            "seed": self._reset.seed,
            "blocks": [[*map(float, block.pose[:3, 3]), yaw_of(block.pose)] for block in self._blocks],
            "plate": discs[0],
            **({"discs": discs} if len(discs) > 1 else {}),
            **({"factors": dict(self._reset.factors)} if self._reset.factors else {}),
            **(self._varied_appearance() if self._appearance != _USUAL else {}),
            "held": [block.held_by for block in self._blocks],
            "milestones": reached,
            "success": all(self._rests(schema.milestones[name], MARGIN_M) for name in schema.success),
        }

    def _varied_appearance(self) -> dict[str, object]:
        varied, numbers = self._varied, range(len(self._blocks))
        return {
            "edges": [varied.edge(number) for number in numbers],
            "colours": [list(varied.colour(number)) for number in numbers],
        }

    def _layout(self, wish: ResetRequest) -> BenchLayout:
        """Return the layout for a reset request.

        Raises:
            BenchError: If it is not possible; nothing has changed then.
        """
        blocks = self._count + round(self._factors.get("distractors", 0))
        return draw_layout(wish.seed, wish.positions, blocks, self.bench.schema)

    def _place_objects(self, wish: ResetRequest) -> None:
        before, self._factors = self._factors, self._factor_values(wish.factors or {})
        try:
            layout = self._layout(wish)
        except BenchError:
            self._factors = before
            raise
        varied = self._varied
        edges = [varied.edge(index) for index in range(len(layout.blocks))]
        self._blocks = [
            Block(block_pose(place, edge), edge) for place, edge in zip(layout.blocks, edges, strict=True)
        ]
        self._discs = np.array(layout.discs).reshape(-1, 2)
        schema = self.bench.schema
        self._reached = {name: False for name, milestone in schema.milestones.items() if milestone.passes}

    def _factor_values(self, factors: Mapping[str, Any]) -> dict[str, float]:
        """Return the value of every factor. Raises: BenchError if the bench does not accept one of `factors`."""
        schema = self.bench.schema
        if problem := next(schema.factor_problems(factors), ""):
            raise BenchError(problem)
        if unknown := [name for name in factors if name in self.unsimulated]:
            raise BenchError(f"factors.{unknown[0]}: allowed on benches with contact forces alone")
        return schema.factor_values(factors)

    def _note(self) -> None:
        """Update the milestones that pass."""
        for name in self._reached:
            self._reached[name] |= self._is_reached(self.bench.schema.milestones[name])

    def _is_reached(self, milestone: Milestone) -> bool:
        block = self._blocks[self.bench.block_names.index(milestone.object)]
        if milestone.when == "held":
            return bool(block.held_by)
        lifted = bool(block.held_by) and block.bottom > LIFTED_M
        return lifted and (milestone.when == "lifted" or self._is_over(block, milestone.on))

    def _is_over(self, block: Block, disc: str, margin: float = 0.0) -> bool:
        """Return True if a block's centre is above a disc, `margin` [m] inside its rim."""
        index = self._disc_index(disc)
        distance = float(np.hypot(*(block.pose[:2, 3] - self._discs[index])))
        return distance < self.bench.discs[index].radius - margin

    def _disc_index(self, name: str) -> int:
        return next(index for index, disc in enumerate(self.bench.discs) if disc.name == name)

    def _rests(self, milestone: Milestone, margin: float = 0.0) -> bool:
        """Return True if the milestone's block is at rest on its disc, `margin` [m] inside the rim."""
        block = self._blocks[self.bench.block_names.index(milestone.object)]
        height = self.bench.discs[self._disc_index(milestone.on)].height
        lies = block.still >= REST_S and abs(block.bottom - height) < 1e-3
        return lies and not block.held_by and self._is_over(block, milestone.on, margin)
