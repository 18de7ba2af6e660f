"""Environments of a simulated node: test patterns, or a bench with objects, with a belt, or with contact forces."""

from __future__ import annotations

import argparse
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

import numpy as np

from runtime.benches.schema import load_schema
from runtime.core.errors import SetupError
from runtime.core.types import Float64, UInt8
from runtime.simulation.bench.bench import Bench
from runtime.simulation.bench.block_table import BlockTable, ResetRequest
from runtime.simulation.bench.conveyor import Conveyor
from runtime.simulation.bench.numbered_frames import Scene
from runtime.simulation.bench.plant import Plant
from runtime.simulation.bench.tabletop import Tabletop

if TYPE_CHECKING:
    from robots import Robot

OWN = (
    "none",
    "tabletop",
    "conveyor",
    "contact",
)  # other values are benches by name, or paths of their folders


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

    @abstractmethod
    def truth(self) -> dict[str, object] | None:
        """Return the ground truth of the bench; None if there is no bench."""

    @abstractmethod
    def reset(self, wish: ResetRequest) -> None:
        """Reset the bench as requested.

        Raises:
            BenchError: If the requested layout is not possible.
        """


class TestPatternEnvironment(Environment):
    """Environment without a bench: moving test patterns, and no objects."""

    __test__ = False  # not a test case, despite the prefix of its name

    def __init__(self, robot: Robot, options: argparse.Namespace) -> None:
        self._scene = Scene(robot, options.height, options.width, options.seed)

    def move(self, plant: Plant, seconds: float) -> None:
        """Advance the plant, which touches nothing."""
        plant.advance(seconds)

    def pictures(self, frame: int, seconds: float, q: Float64) -> dict[str, UInt8]:
        """Return test patterns that contain the frame number."""
        return self._scene.draw(frame, seconds, q)

    def truth(self) -> None:
        """Return None, because there is no bench."""

    def reset(self, wish: ResetRequest) -> None:
        """Raise AssertionError: without a bench the command gate refuses such requests."""
        raise AssertionError(f"reset {wish.id} of a bench that is not there")


class BenchEnvironment(Environment):
    """Environment with a simulated bench, and the renderer of its cameras."""

    def __init__(self, robot: Robot, options: argparse.Namespace, tabletop: BlockTable) -> None:
        import cv2  # no other environment needs it

        from runtime.simulation.render import Renderer

        cv2.setNumThreads(1)  # the other cores belong to the station
        self._tabletop = tabletop
        self._renderer = Renderer(robot, tabletop.bench, options.width, options.height)
        self._drawn: tuple[bytes, dict[str, UInt8]] = (b"", {})  # state that was drawn last, and its images

    def move(self, plant: Plant, seconds: float) -> None:
        """Advance the plant, and the objects that its fingers touch."""
        self._tabletop.advance(plant, seconds)

    def pictures(self, frame: int, seconds: float, q: Float64) -> dict[str, UInt8]:
        """Return the rendered images.

        They are drawn only if something has moved, because drawing is most of the work.
        """
        state = self._tabletop.state()
        view = (state.light, *state.camera_shift, state.size, state.hue)
        poses = (block.pose.ravel() for block in state.blocks)
        moment = np.concatenate([q, view, *state.discs, *poses]).tobytes()
        if moment != self._drawn[0]:
            self._drawn = moment, self._renderer.draw(q, state)
            for picture in self._drawn[1].values():
                picture.setflags(write=False)  # the same arrays may be returned again
        return dict(self._drawn[1])

    def truth(self) -> dict[str, object]:
        """Return the places of objects on the bench, and the progress of the task."""
        return self._tabletop.truth()

    def reset(self, wish: ResetRequest) -> None:
        """Reset the bench as requested."""
        self._tabletop.reset(wish)


def make_environment(robot: Robot, options: argparse.Namespace) -> Environment:
    """Return the environment that `options.bench` names.

    "contact" is the tabletop with contact forces; benches by name or path have contact forces.

    Raises:
        SetupError: If --blocks is not 1 with a conveyor, there is no such bench, or the contact physics is not
            installed.
        BenchError: If the blocks do not fit on the bench.
    """
    if options.bench == "conveyor":
        if options.blocks != 1:
            raise SetupError(
                f"--blocks {options.blocks} with --bench conveyor: one block rides on the belt; allowed: 1"
            )
        return BenchEnvironment(robot, options, Conveyor(robot, options.seed))
    if options.bench == "tabletop":
        return BenchEnvironment(robot, options, Tabletop(robot, options.seed, options.blocks))
    if options.bench == "none":
        return TestPatternEnvironment(robot, options)
    from runtime.simulation.contact.bench import ContactTabletop  # no other environment needs its modules

    table = Bench(load_schema("tabletop" if options.bench == "contact" else options.bench))
    return BenchEnvironment(robot, options, ContactTabletop(robot, options.seed, options.blocks, table))
