"""Scripts of stand-in policy servers; a script restarts with every connection."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from runtime.core.types import Float32, Float64, UInt8
from runtime.simulation.scripts.gestures import Gesture

if TYPE_CHECKING:
    from robots import Robot

Answer = Callable[[Float64, Mapping[str, UInt8], str], Float32]
"""Function of joints float64 [D], images by request key and instruction: rows float32 [H, D]."""


class Script(ABC):
    """Policy without a model, which restarts with every connection; the server sends `metadata` on connection."""

    metadata: Mapping[str, object]

    @abstractmethod
    def begin(self) -> Answer:
        """Return a function that answers the requests of one connection, in the order in which they arrive."""


class WavingScript(Script):
    """Script whose rows follow a gesture around home; they depend only on the joints."""

    def __init__(
        self, robot: Robot, horizon: int, rate: float, seed: int = 0, name: str | None = None
    ) -> None:
        self._gesture = Gesture(robot, seed)
        self._horizon, self._rate = horizon, rate
        self.metadata = {"name": name or "stand-in", "action_horizon": horizon}

    def begin(self) -> Answer:
        return lambda q, pictures, prompt: self._gesture.chunk(q, self._horizon, self._rate)
