"""Fast quantiles of a few thousand values, for statistics several times a second."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from runtime.core.types import Float64


def quantiles(figures: Float64, fractions: Sequence[float]) -> list[float]:
    """Return the quantiles of `figures` [N], N > 0, equal to those of `numpy.quantile` within rounding.

    It is many times faster.
    """
    ordered = np.sort(figures)
    values, last = [], len(ordered) - 1
    for fraction in fractions:
        below = int(fraction * last)
        low, high = float(ordered[below]), float(ordered[min(below + 1, last)])
        values.append(low + (fraction * last - below) * (high - low))
    return values
