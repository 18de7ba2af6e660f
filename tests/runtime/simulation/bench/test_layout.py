from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import robots
from runtime.simulation.bench.bench import TABLETOP, Bench, BenchError
from runtime.simulation.bench.layout import (
    NOISE_M,
    NOISE_RAD,
    draw_layout,
)

ROBOT = robots.load_robot("agilex_piper")
X_FROM, X_TO, Y_FROM, Y_TO = Bench().area
APART_M = TABLETOP.distance("block", "plate")
SEEDS = st.integers(0, 2**63 - 1)


@given(SEEDS, st.integers(1, 4))
def test_every_layout_lies_in_the_area_apart_and_on_one_side(seed: int, blocks: int) -> None:
    layout = draw_layout(seed, None, blocks)
    assert len(layout.blocks) == blocks
    for x, y, _ in [*layout.blocks, (*layout.discs[0], 0.0)]:
        assert X_FROM <= x <= X_TO
        assert Y_FROM <= y <= Y_TO
    assert all(math.dist(block[:2], layout.discs[0]) >= APART_M for block in layout.blocks)
    apart = [math.dist(a[:2], b[:2]) for a in layout.blocks for b in layout.blocks if a is not b]
    assert min(apart, default=1.0) > 0.08
    feet = [arm.mount[:2] for arm in ROBOT.arms]
    task = (layout.blocks[0][:2], layout.discs[0])
    assert any(all(math.dist(foot, place) <= 0.42 for place in task) for foot in feet)


@given(SEEDS)
def test_a_layout_is_always_the_same_for_a_seed_and_near_what_was_asked_for(seed: int) -> None:
    positions = {"block": [0.1, 0.2, 30.0], "plate": [0.15, 0.36]}
    layout = draw_layout(seed, positions)
    assert layout == draw_layout(seed, positions)
    x, y, yaw = layout.blocks[0]
    assert np.abs(np.subtract((x, y, *layout.discs[0]), (0.1, 0.2, 0.15, 0.36))).max() <= NOISE_M
    assert abs(yaw - math.radians(30)) <= NOISE_RAD


def test_layouts_differ_by_seed_with_and_without_positions() -> None:
    for positions in (None, {"block": [0.1, 0.2, 0.0], "plate": [0.15, 0.36]}, {"plate": [0.1, 0.3]}):
        assert len({draw_layout(seed, positions) for seed in range(20)}) == 20


@pytest.mark.parametrize(
    ("positions", "says"),
    [
        ({"bowl": [0.0, 0.3]}, "bowl: unknown object; allowed: plate, block"),
        ({"block": [0.0, 0.3]}, "allowed: 3 finite numbers"),
        ({"block": "here"}, "allowed: 3 finite numbers"),
        ({"plate": [0.0, math.nan]}, "allowed: 2 finite numbers"),
        ({"plate": [0.0, True]}, "allowed: 2 finite numbers"),
        ({"plate": [0.5, 0.3]}, "allowed on a simulated bench: x -220 to 220, y 180 to 400 mm"),
        ({"block": [0.0, 0.3, 0.0], "plate": [0.1, 0.3]}, "100 mm apart; allowed: 150 mm or more"),
        ({"block": [0.0, 0.3, 0.0], 3: [0.1, 0.3]}, "3: unknown object"),
    ],
)
def test_positions_that_cannot_be_are_refused_with_a_sentence(positions: dict, says: str) -> None:
    with pytest.raises(BenchError, match=says):
        draw_layout(0, positions)


@pytest.mark.parametrize(("seed", "blocks"), [(0, 0), (-1, 1), (0, 60)])
def test_blocks_that_do_not_fit_are_refused(seed: int, blocks: int) -> None:
    with pytest.raises(BenchError, match="block"):
        draw_layout(seed, None, blocks)
