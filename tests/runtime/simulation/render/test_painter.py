from __future__ import annotations

import numpy as np
import pytest

from runtime.simulation.bench.bench import PinholeCamera
from runtime.simulation.render.painter import Painter
from runtime.simulation.render.solids import Solid, Solids

CAMERA = PinholeCamera(60.0, 60.0, 31.5, 23.5, 64, 48, np.eye(4))  # looks along z from the origin


def scene(*heights: float) -> Solids:
    """Boxes ahead of the camera, at x = 0 and these z."""

    def placed(z: float) -> Solid:
        origin = np.eye(4)
        origin[2, 3] = z
        return Solid(0, "box", (0.4, 0.4, 0.1), origin, (1.0, 1.0 / z if z > 0 else 0.0, 0.0))

    return Solids([placed(z) for z in heights])


def painted(solids: Solids, seen: list[bool] | None = None) -> np.ndarray:
    picture = np.zeros((48, 64, 3), np.uint8)
    placed = solids.placed(np.eye(4)[None])
    if seen is not None:
        placed.seen[:] = seen
    Painter(solids, placed).paint(picture, CAMERA)
    return picture


@pytest.mark.parametrize("solids", [scene(-1.0), scene(-1.0, -2.0)])
def test_a_camera_that_sees_no_solid_has_its_picture_left_alone(solids: Solids) -> None:
    assert not painted(solids).any()


def test_what_is_not_to_be_seen_is_not_drawn_and_hides_nothing() -> None:
    both = scene(1.0, 2.0)
    np.testing.assert_array_equal(painted(both, [False, True]), painted(scene(2.0)))
    np.testing.assert_array_equal(painted(both, [False, False]), 0)


def test_the_nearer_one_is_drawn_over_the_farther_one() -> None:
    middle = painted(scene(2.0, 1.0))[24, 32]
    np.testing.assert_array_equal(middle, painted(scene(1.0))[24, 32])
    assert (middle != painted(scene(2.0))[24, 32]).any()
