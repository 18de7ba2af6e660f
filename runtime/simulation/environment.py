"""Interface of the environments of a simulated node."""

from __future__ import annotations

from abc import ABC, abstractmethod

from runtime.core.types import Float64, UInt8
from runtime.simulation.bench.block_table import ResetRequest
from runtime.simulation.bench.plant import Plant


class Environment(ABC):
    """Environment of a simulated robot: it advances the robot and everything that it touches, and renders the
    cameras.
    """

    @abstractmethod
    def move(self, plant: Plant, seconds: float) -> None:
        """Advance the plant and everything that it touches by `seconds`."""

    @abstractmethod
    def pictures(self, frame: int, seconds: float, q: Float64) -> dict[str, UInt8]:
        """Return a BGR uint8 [H, W, 3] image per camera key; callers must not write to them."""

    def state_vector(self) -> Float64 | None:
        """Return a benchmark's own observation vector; None if there is none."""
        return None

    @abstractmethod
    def truth(self) -> dict[str, object] | None:
        """Return the ground truth of the bench; None if there is no bench."""

    @abstractmethod
    def reset(self, wish: ResetRequest) -> None:
        """Reset the bench as requested.

        Raises:
            BenchError: If the requested layout is not possible.
        """

    def close(self) -> None:  # noqa: B027  # only programs of their own have something to end
        """End what the environment has started."""
