"""The distance of two segments, against a search over both."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from robots import clearance

point = st.tuples(*[st.floats(-1.0, 1.0, width=32)] * 3)
ORIGIN = (0.0, 0.0, 0.0)


def to_segment(point: np.ndarray, start: np.ndarray, way: np.ndarray) -> float:
    """A point's distance from a segment."""
    length = way @ way
    along = 0.0 if length == 0 else np.clip((point - start) @ way / length, 0, 1)
    return float(np.linalg.norm(point - start - along * way))


def searched(start: np.ndarray, way: np.ndarray, other: np.ndarray, other_way: np.ndarray) -> float:
    """The distance is convex along the first segment: a search along it, and its ends."""

    def away(s: float) -> float:
        return to_segment(start + s * way, other, other_way)

    best = minimize_scalar(away, bounds=(0, 1), method="bounded", options={"xatol": 1e-10}).fun
    return min(best, away(0.0), away(1.0))


@given(st.tuples(point, point, point, point))
@example((ORIGIN, ORIGIN, ORIGIN, ORIGIN))
@example((ORIGIN, (1, 0, 0), (0.2, 0.5, 0), (0.5, 0, 0)))
@example((ORIGIN, (1, 0, 0), (3, 0, 0), (-1, 0, 0)))
@example((ORIGIN, (1, 0, 0), (0.5, 0, 0.3), ORIGIN))
@example((ORIGIN, (1, 0, 0), (0.5, -1, 0.25), (0, 2, 0)))
@example((ORIGIN, (1, 0, 0), (0.0, 0.5, 0), (1.0, 1e-8, 0)))
def test_it_is_what_a_search_finds_whatever_way_the_segments_lie(
    lying: tuple[tuple[float, ...], ...],
) -> None:
    parts = [np.array(part, float) for part in lying]
    assert float(clearance.segment_distances(*parts)) == pytest.approx(searched(*parts), abs=1e-7)
    start, way, other, other_way = parts
    assert float(clearance.segment_distances(other, other_way, start, way)) == pytest.approx(
        searched(*parts), abs=1e-7
    )


def test_many_pairs_are_judged_at_once_as_each_is_alone() -> None:
    parts = np.random.default_rng(1).normal(size=(4, 5, 7, 3))
    found = clearance.segment_distances(*parts)
    assert found.shape == (5, 7)
    for index in np.ndindex(5, 7):
        assert found[index] == pytest.approx(
            float(clearance.segment_distances(*(part[index] for part in parts)))
        )
