from __future__ import annotations

import numpy as np

from runtime.simulation.render.order import Order, painted
from runtime.simulation.render.solids import Solid, Solids


def placed_at(*boxes: tuple[tuple[float, float, float], tuple[float, float, float]]) -> Order:
    solids = []
    for size, centre in boxes:
        origin = np.eye(4)
        origin[:3, 3] = centre
        solids.append(Solid(0, "box", size, origin, (0.5, 0.5, 0.5)))
    all_of_them = Solids(solids)
    placed = all_of_them.placed(np.eye(4)[None])
    return Order(placed.axes, placed.centres, all_of_them.halves)


def test_what_lies_on_a_large_thing_hides_it_although_its_middle_is_farther_from_the_eye() -> None:
    order = placed_at(((2.0, 2.0, 0.1), (0.0, 0.0, 0.0)), ((0.1, 0.1, 0.1), (0.95, 0.0, 0.1)))
    eye = np.array([-0.9, 0.0, 0.8], np.float32)
    hides = order.hides(eye)
    assert hides[0, 1]
    assert not hides[1, 0]
    below = order.hides(np.array([-0.9, 0.0, -0.8], np.float32))
    assert below[1, 0]
    assert not below[0, 1]


def test_the_nearer_of_two_in_a_row_hides_the_other_from_either_side() -> None:
    order = placed_at(((0.2, 0.2, 0.2), (0.0, 0.0, 0.0)), ((0.2, 0.2, 0.2), (1.0, 0.05, 0.0)))
    for x, front in ((-3.0, 0), (4.0, 1)):
        hides = order.hides(np.array([x, 0.0, 0.0], np.float32))
        assert hides[1 - front, front]
        assert not hides[front, 1 - front]


def test_the_hidden_come_first_and_the_farther_first_among_the_rest() -> None:
    hides = np.zeros((4, 4), bool)
    hides[3, 0] = hides[0, 2] = hides[1, 2] = True
    everywhere = np.ones((4, 4), bool)
    assert painted(hides, everywhere, np.array([1, 2, 9, 0.5], np.float32)) == [1, 3, 0, 2]
    assert painted(hides, ~everywhere, np.array([1, 2, 9, 0.5], np.float32)) == [2, 1, 0, 3]


def test_a_circle_is_broken_at_its_farthest() -> None:
    hides = np.zeros((3, 3), bool)
    hides[0, 1] = hides[1, 2] = hides[2, 0] = True
    assert painted(hides, np.ones((3, 3), bool), np.array([1, 3, 2], np.float32)) == [1, 2, 0]
