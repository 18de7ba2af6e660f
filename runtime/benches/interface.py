"""What a bench's own program implements: a file with a function `make_bench`, which returns a `Bench`.

The program runs in an environment of its own, with `runtime.benches.host` around it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np


class Refusal(ValueError):
    """Error for a person to read: the bench cannot do what was asked."""


@dataclass(frozen=True)
class Moment:
    """State of a bench after a reset or step.

    Attributes:
        state: Measured numbers of the robot, float32 [D].
        observation: The benchmark's own observation vector, float64 [V]; None if it has none.
        milestones: What has been reached since the last reset, by the names of bench.toml.
        over: Why the episode is over; "" if it goes on. No step follows after that.
    """

    state: np.ndarray[Any, Any]
    observation: np.ndarray[Any, Any] | None
    milestones: Mapping[str, bool]
    over: str = ""


class Bench(Protocol):
    """What the function `make_bench` of a bench's program returns.

    The result of `reset` and of all steps after it may depend on the arguments alone.
    """

    dim: int
    observation: int
    milestones: Sequence[str]
    cameras: Sequence[str]

    def reset(self, seed: int, choices: Mapping[str, str]) -> Moment:
        """Begin an episode. Raises: Refusal if it is not possible."""

    def step(self, row: np.ndarray[Any, Any]) -> Moment:
        """Execute one row of a policy, float32 [D], as it is."""

    def observe(self, width: int, height: int) -> Mapping[str, np.ndarray[Any, Any]]:
        """Return the cameras' images of the present state: RGB uint8 [height, width, 3]."""
