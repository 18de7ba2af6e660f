"""What a workbench's cameras see is drawn anew whenever anything has moved, and only then."""

from __future__ import annotations

import numpy as np
import pytest

import robots
from runtime.simulation import node
from runtime.simulation.bench.block_table import ResetRequest
from runtime.simulation.bench.conveyor import Conveyor
from runtime.simulation.bench.plant import Plant
from runtime.simulation.bench.tabletop import Tabletop
from runtime.simulation.environments import BenchEnvironment
from runtime.simulation.render import Renderer

ROBOT = robots.load_robot("agilex_piper")
OPTIONS = node.parser().parse_args(["--robot", "agilex_piper", "--width", "64", "--height", "48"])


@pytest.mark.some(1)
@pytest.mark.parametrize("kind", [Tabletop, Conveyor])
def test_pictures_are_those_of_the_moment(kind: type[Tabletop]) -> None:
    bench = kind(ROBOT, 0)
    around, renderer = BenchEnvironment(ROBOT, OPTIONS, bench), Renderer(ROBOT, bench.bench, 64, 48)
    plant = Plant(ROBOT)
    drawn = []
    for step in range(90):
        if step == 5:
            plant.target = ROBOT.poses["ready"]
        if step == 60:
            around.reset(ResetRequest("another", 7))
        around.move(plant, 1 / 30)
        drawn.append(around.pictures(step, step / 30, plant.q))
        for key, picture in renderer.draw(plant.q, bench.state()).items():
            np.testing.assert_array_equal(drawn[-1][key], picture)
    if kind is Tabletop:  # a belt moves by itself
        assert all(drawn[1][key] is drawn[2][key] for key in drawn[1])
    assert not np.array_equal(drawn[59]["cam_high"], drawn[60]["cam_high"])
