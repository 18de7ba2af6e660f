from __future__ import annotations

import numpy as np
import pytest

from runtime.simulation.bench.bench import PinholeCamera
from runtime.simulation.render import rasteriser
from runtime.simulation.render.rasteriser import PAINT, Ground, View
from runtime.simulation.render.solids import Solid, Solids, shape_solid

CAMERA = PinholeCamera(60.0, 60.0, 31.5, 23.5, 64, 48, np.eye(4))  # looks along z from the origin
RED, BLUE = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)


def box(
    place: tuple[float, float, float],
    size: tuple[float, float, float] = (0.4, 0.4, 0.1),
    colour: tuple[float, float, float] = RED,
    turn: float = 0.0,
) -> Solid:
    """Box at a place in front of the camera, turned about the vertical of the image [rad]."""
    origin = np.eye(4)
    origin[:3, :3] = [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    origin[:3, 3] = place
    return shape_solid(0, "box", size, origin, colour, PAINT)


def drawn(*solids: Solid, gain: float = 1.0) -> np.ndarray:
    """Picture of solids in a room, without a table."""
    scene = Solids(solids)
    vertices, normals = scene.placed(np.eye(4)[None])
    picture = np.empty((48, 64, 3), np.uint8)
    rays = np.linalg.inv(CAMERA.lens)
    view = View((0.0, 0.0, 0.0), *(tuple(map(tuple, m.tolist())) for m in (CAMERA.lens, rays)), gain)
    scratch = rasteriser.make_scratch(scene.geometry, 64, 48)
    texture, light = np.zeros((2, 2), np.uint32), np.zeros((2, 2), np.uint8)
    rasteriser.draw(
        scene.geometry, vertices, normals, view, Ground(0, 0, 1, 1), texture, light, scratch, picture
    )
    return picture


def is_red(picture: np.ndarray) -> np.ndarray:
    return (picture[..., 2] > 100) & (picture[..., 0] < 60)


def is_blue(picture: np.ndarray) -> np.ndarray:
    return (picture[..., 0] > 100) & (picture[..., 2] < 60)


@pytest.mark.parametrize("place", [(0.0, 0.0, -1.0), (5.0, 0.0, 1.0), (0.0, -5.0, 1.0), (0.0, 0.0, 0.0)])
def test_solids_behind_beside_or_around_the_camera_leave_the_room_as_it_is(
    place: tuple[float, float, float],
) -> None:
    np.testing.assert_array_equal(drawn(box(place)), drawn(box((0.0, 0.0, -9.0))))


@pytest.mark.parametrize("swapped", [False, True])
def test_of_two_that_pass_through_each_other_each_hides_the_other_where_it_is_nearer(swapped: bool) -> None:
    crossed = [
        box((0.0, 0.0, 1.0), (0.6, 0.4, 0.02), RED, 0.7),
        box((0.0, 0.0, 1.0), (0.6, 0.4, 0.02), BLUE, -0.7),
    ]
    picture = drawn(*crossed[:: -1 if swapped else 1])
    row = picture[24]
    assert is_red(row[48])
    assert is_blue(row[15])
    assert np.flatnonzero(is_red(row)).min() > np.flatnonzero(is_blue(row)).max()


def test_a_face_that_extends_behind_the_camera_is_drawn_as_far_as_it_is_ahead() -> None:
    floor = box((0.0, 0.3, 0.0), (4.0, 0.02, 4.0))
    picture = drawn(floor)
    horizon = 23.5 + 60 * 0.29 / 2.0
    assert is_red(picture[int(horizon) + 2 :]).all()
    assert not is_red(picture[: int(horizon) - 1]).any()


def test_a_pixel_at_an_edge_is_between_the_colours_on_its_two_sides() -> None:
    picture, room = drawn(box((0.05, 0.0, 1.0), (0.4, 0.4, 0.1), turn=0.0)).astype(int), drawn(box((9, 0, 1)))
    left = CAMERA.project(np.array([0.05 - 0.2, 0.0, 0.95]))[0]
    column = round(left)
    covered = column + 0.5 - left
    inner, outer = picture[24, column + 1], room[24, column - 1].astype(int)
    np.testing.assert_allclose(picture[24, column], covered * inner + (1 - covered) * outer, atol=255 / 8)
    assert (picture[24, column] != inner).any()
    assert (picture[24, column] != outer).any()


def test_a_painted_solid_has_lighter_edges_one_pixel_wide() -> None:
    row = drawn(box((0.0, 0.0, 1.0)))[24].astype(int)
    inside = np.flatnonzero(is_red(row))
    first = inside[row[inside, 2] == row[inside, 2].max()][0]
    assert row[first, 2] > row[32, 2]
    np.testing.assert_array_equal(row[first + 2], row[32])


def test_the_gain_multiplies_all_colours_up_to_white() -> None:
    plain, bright = drawn(box((0.0, 0.0, 1.0))), drawn(box((0.0, 0.0, 1.0)), gain=1.5)
    np.testing.assert_allclose(bright, np.minimum(1.5 * plain.astype(float), 255), atol=1.5)
