"""Resampling of rows from one rate to another, by column kind: linear, spherical, or held."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from robots.rotations import slerp
from runtime.core.types import Float64


def resampled_length(count: int, rate: float, wanted_rate: float) -> int:
    """Return the number of rows, at least 1, to which `resample` converts `count` rows at these rates [Hz]."""
    return math.floor((count - 1) * wanted_rate / rate + 1e-9) + 1


def resample(
    rows: Float64,
    rate: float,
    wanted_rate: float,
    held: Sequence[int] = (),
    quaternions: Sequence[int] = (),
) -> tuple[Float64, NDArray[np.int64]]:
    """Resample `rows` [H, W] from `rate` to `wanted_rate` [Hz].

    Columns are interpolated linearly, with two exceptions: `held` columns (binary grippers) repeat the earlier row's
    value, and the four columns from each index in `quaternions` (unit) are interpolated on the shorter arc. The
    result ends at or before the last row: rows beyond it would be invented, and would pull the mean of agreeing
    chunks towards the past.

    Returns:
        The resampled rows [H', W], and for each the index int64 [H'] of the last input row that is not later.
    """
    if rate == wanted_rate or not len(rows):
        return rows, np.arange(len(rows), dtype=np.int64)
    steps = np.arange(resampled_length(len(rows), rate, wanted_rate))
    position = np.minimum(steps * (rate / wanted_rate), len(rows) - 1)
    lower = np.floor(position + 1e-9).astype(np.int64)
    before, after = rows[lower], rows[np.minimum(lower + 1, len(rows) - 1)]
    part = np.clip(position - lower, 0.0, 1.0)
    resampled = before + part[:, None] * (after - before)
    resampled[:, list(held)] = before[:, list(held)]
    for first in quaternions:
        turned = slice(first, first + 4)
        resampled[:, turned] = slerp(before[:, turned], after[:, turned], part)
    return resampled, lower
