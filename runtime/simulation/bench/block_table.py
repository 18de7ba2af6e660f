"""Blocks and a plate on the simulated bench: their layout, the milestones of the task and the ground truth.

Subclasses decide how blocks move: by rules (`tabletop.py`) or by contact forces (`runtime/simulation/contact`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from runtime.simulation.bench.bench import Bench, BenchLayout, BenchState, block_pose, yaw_of
from runtime.simulation.bench.block import Block
from runtime.simulation.bench.layout import draw_layout
from runtime.simulation.bench.plant import Plant

REST_S = 0.2  # time without motion after which a block is at rest
LIFTED_M = 0.03  # height above the table from which a held block counts as lifted
MARGIN_M = 0.01  # least distance of the block's centre inside the plate's rim for success


@dataclass(frozen=True, slots=True)
class ResetRequest:
    """Request for a new layout of the bench; `id` distinguishes new requests from repetitions."""

    id: str
    seed: int
    positions: Mapping[str, Any] | None = None


class BlockTable(ABC):
    """Blocks and a plate in front of one robot; `advance` moves the robot's plant and everything that it touches."""

    def __init__(self, seed: int, blocks: int = 1, bench: Bench | None = None) -> None:
        self.bench = bench or Bench()
        self._count = blocks
        self._blocks: list[Block] = []
        self._plate = np.zeros(2)
        self._reached: dict[str, bool] = {}
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
