"""A simulated node's surroundings: test pictures, a bench with blocks and a plate, or one with a belt."""

from __future__ import annotations

import argparse
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

import numpy as np

from runtime.core.errors import SetupError
from runtime.core.types import Float64, UInt8
from runtime.simulation.bench.conveyor import Conveyor
from runtime.simulation.bench.numbered_frames import Scene
from runtime.simulation.bench.plant import Plant
from runtime.simulation.bench.tabletop import ResetRequest, Tabletop

if TYPE_CHECKING:
    from robots import Robot

NAMES = ("none", "tabletop", "conveyor")


class Environment(ABC):
    """Effects of time on everything but the node itself, and the pictures of its cameras."""

    @abstractmethod
    def move(self, plant: Plant, seconds: float) -> None:
        """Let time pass for the plant and all that it touches."""

    @abstractmethod
    def pictures(self, frame: int, seconds: float, q: Float64) -> dict[str, UInt8]:
        """One BGR uint8 [H, W, 3] per camera key; whoever has them may not write to them."""

    @abstractmethod
    def truth(self) -> dict[str, object] | None:
        """Ground truth of the bench; None where there is none."""

    @abstractmethod
    def reset(self, wish: ResetRequest) -> None:
        """Lay the bench anew; BenchError where that cannot be."""


class TestPatternEnvironment(Environment):
    """Moving test pictures and nothing to touch."""

    __test__ = False  # no test case, whatever its name begins with

    def __init__(self, robot: Robot, options: argparse.Namespace) -> None:
        self._scene = Scene(robot, options.height, options.width, options.seed)

    def move(self, plant: Plant, seconds: float) -> None:
        """The plant moves freely."""
        plant.advance(seconds)

    def pictures(self, frame: int, seconds: float, q: Float64) -> dict[str, UInt8]:
        """Test pictures with the frame's number in them."""
        return self._scene.draw(frame, seconds, q)

    def truth(self) -> None:
        """Nothing lies anywhere."""

    def reset(self, wish: ResetRequest) -> None:
        """There is nothing to lay; the gate lets no wish come here."""
        raise AssertionError(f"reset {wish.id} of a bench that is not there")


class BenchEnvironment(Environment):
    """A tabletop, and its pictures."""

    def __init__(self, robot: Robot, options: argparse.Namespace, tabletop: Tabletop) -> None:
        import cv2  # which no other node needs

        from runtime.simulation.render import Renderer

        cv2.setNumThreads(1)  # the other cores belong to the station
        self._tabletop = tabletop
        self._renderer = Renderer(robot, tabletop.bench, options.width, options.height)
        self._drawn: tuple[bytes, dict[str, UInt8]] = (b"", {})  # the last moment, and how it looks

    def move(self, plant: Plant, seconds: float) -> None:
        """The plant moves, and what its fingers touch."""
        self._tabletop.advance(plant, seconds)

    def pictures(self, frame: int, seconds: float, q: Float64) -> dict[str, UInt8]:
        """The bench as the cameras see it; drawn anew only where something has moved, which is most of the work."""
        state = self._tabletop.state()
        moment = np.concatenate([q, state.plate, *(block.pose.ravel() for block in state.blocks)]).tobytes()
        if moment != self._drawn[0]:
            self._drawn = moment, self._renderer.draw(q, state)
            for picture in self._drawn[1].values():
                picture.setflags(write=False)  # it may be shown again
        return dict(self._drawn[1])

    def truth(self) -> dict[str, object]:
        """Places of things on the bench, and progress of the task."""
        return self._tabletop.truth()

    def reset(self, wish: ResetRequest) -> None:
        """Lay the bench as wished."""
        self._tabletop.reset(wish)


def make_environment(robot: Robot, options: argparse.Namespace) -> Environment:
    """Those that `options.bench` names; SetupError for more blocks than it takes."""
    if options.bench == "conveyor":
        if options.blocks != 1:
            raise SetupError(
                f"--blocks {options.blocks} with --bench conveyor: one block rides on the belt; allowed: 1"
            )
        return BenchEnvironment(robot, options, Conveyor(robot, options.seed))
    if options.bench == "tabletop":
        return BenchEnvironment(robot, options, Tabletop(robot, options.seed, options.blocks))
    return TestPatternEnvironment(robot, options)
