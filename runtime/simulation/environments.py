"""Environments of a simulated node: test patterns, or a bench with objects, with a belt, or with contact forces."""

from __future__ import annotations

import argparse
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
from runtime.simulation.environment import Environment

if TYPE_CHECKING:
    from robots import Robot

OWN = (
    "none",
    "tabletop",
    "conveyor",
    "contact",
)  # other values are benches by name, or paths of their folders


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
        SetupError: If --blocks is not 1 with a conveyor, there is no such bench, the contact physics or the
            environment of the bench's own program is not installed, or that program does not start.
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
    if options.bench != "contact" and load_schema(options.bench).program is not None:
        from runtime.simulation.own_program import (
            ProgramEnvironment,
        )  # no other environment needs its modules

        return ProgramEnvironment(robot, options)
    from runtime.simulation.contact.bench import ContactTabletop  # no other environment needs its modules

    table = Bench(load_schema("tabletop" if options.bench == "contact" else options.bench))
    return BenchEnvironment(robot, options, ContactTabletop(robot, options.seed, options.blocks, table))
