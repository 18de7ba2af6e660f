"""Histogram of durations in constant memory, with buckets one per cent wide."""

from __future__ import annotations

import math

import numpy as np

_LEAST, _MOST = 1e-4, 1e5  # [s]; durations outside count as these
_STEP = math.log(1.01)
_BUCKETS = math.ceil(math.log(_MOST / _LEAST) / _STEP) + 1


class DurationHistogram:
    """Histogram of durations [s]; numbers that are not finite are ignored."""

    def __init__(self) -> None:
        self._counts = np.zeros(_BUCKETS, dtype=np.int64)
        self._longest = -math.inf

    def add(self, seconds: float) -> None:
        """Add one duration [s]."""
        if not math.isfinite(seconds):
            return
        within = min(max(seconds, _LEAST), _MOST)
        self._counts[int(math.log(within / _LEAST) / _STEP)] += 1
        self._longest = max(self._longest, seconds)

    def milliseconds(self) -> dict[str, float] | None:
        """Return p50 and p99 with an error of one per cent, and the exact maximum [ms]; None if it is empty."""
        total = int(self._counts.sum())
        if not total:
            return None
        return {
            "p50": self._quantile(0.50, total) * 1000.0,
            "p99": self._quantile(0.99, total) * 1000.0,
            "max": self._longest * 1000.0,
        }

    def _quantile(self, share: float, total: int) -> float:
        """Return the middle of the bucket with the quantile, at most the longest duration."""
        bucket = int(np.searchsorted(np.cumsum(self._counts), share * total))
        return min(_LEAST * math.exp((min(bucket, _BUCKETS - 1) + 0.5) * _STEP), self._longest)
