"""Distance of two line segments."""

from __future__ import annotations

import numpy as np

from robots.rotations import Float64

_TINY = 1e-300  # avoids division by zero
_PARALLEL = (
    1e-12  # squared sine of the angle below which segments count as parallel: any starting point will do
)


def segment_distances(start: Float64, way: Float64, other: Float64, other_way: Float64) -> Float64:
    """Return the distances [...] of segments [..., 3] from `start` along `way` to those from `other` along
    `other_way`.

    Closest points of the two lines, clamped to the segments one after the other (Ericson, Real-Time Collision
    Detection, 5.1.9); segments may be points, and parallel.
    """
    between = start - other
    a, e = _dot(way, way), _dot(other_way, other_way)
    b, c, f = _dot(way, other_way), _dot(way, between), _dot(other_way, between)
    area = a * e - b * b
    slanting = area > _PARALLEL * a * e
    s = np.where(slanting, np.clip((b * f - c * e) / np.where(slanting, area, 1.0), 0.0, 1.0), 0.0)
    t = np.clip((b * s + f) / np.maximum(e, _TINY), 0.0, 1.0)
    s = np.clip((b * t - c) / np.maximum(a, _TINY), 0.0, 1.0)
    apart = between + s[..., None] * way - t[..., None] * other_way
    return np.asarray(np.sqrt(_dot(apart, apart)))


def _dot(one: Float64, other: Float64) -> Float64:
    return np.asarray(np.einsum("...i,...i->...", one, other))
