"""Rows of one rate as rows of another: linear, on the arc, or held, as each number's kind wants it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from robots.rotations import slerp
from runtime.core.types import Float64


def resampled_length(count: int, rate: float, wanted_rate: float) -> int:
    """Number of rows at `wanted_rate` Hz for `count` rows of `rate` Hz: first to last, at least 1."""
    return math.floor((count - 1) * wanted_rate / rate + 1e-9) + 1


def resample(
    rows: Float64,
    rate: float,
    wanted_rate: float,
    held: Sequence[int] = (),
    quaternions: Sequence[int] = (),
) -> tuple[Float64, NDArray[np.int64]]:
    """`rows` [H, W] of `rate` Hz at `wanted_rate` Hz, and the row each one was made from (the one not after it).

    Numbers are linear between rows; the columns `held` (binary grippers) keep their row's value, and four
    columns from each of `quaternions` on (unit) turn on the shorter arc. Nothing is made beyond the last row: to
    hold it on would say what the policy did not, and pull the mean of chunks that agree towards the past.
    """
    if rate == wanted_rate or not len(rows):
        return rows, np.arange(len(rows), dtype=np.int64)
    steps = np.arange(resampled_length(len(rows), rate, wanted_rate))
    position = np.minimum(steps * (rate / wanted_rate), len(rows) - 1)
    lower = np.floor(position + 1e-9).astype(np.int64)
    before, after = rows[lower], rows[np.minimum(lower + 1, len(rows) - 1)]
    part = np.clip(position - lower, 0.0, 1.0)
    made = before + part[:, None] * (after - before)
    made[:, list(held)] = before[:, list(held)]
    for first in quaternions:
        turned = slice(first, first + 4)
        made[:, turned] = slerp(before[:, turned], after[:, turned], part)
    return made, lower
