"""Statistics of an episode's columns and pictures, and of all episodes, as LeRobot v2.1 keeps them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.errors import RecordingError
from runtime.types import UInt8

Statistic = dict[str, list[Any]]  # min, max, mean, std: lists of the feature's shape; count: [n]
SAMPLED_PICTURES = 100  # per video and episode


def column_statistic(values: NDArray[Any]) -> Statistic | None:
    """Of one column [N] or [N, W], over the rows where it is known; None where it is known nowhere.

    The deviation is that of the population. Unknown rows are NaN and not counted.
    """
    rows = values.reshape(len(values), -1)
    known = rows[~np.isnan(rows).any(axis=1)] if np.issubdtype(rows.dtype, np.floating) else rows
    if not len(known):
        return None
    exact = known.astype(np.float64)
    return {
        "min": known.min(axis=0).tolist(),
        "max": known.max(axis=0).tolist(),
        "mean": exact.mean(axis=0).tolist(),
        "std": exact.std(axis=0).tolist(),
        "count": [len(known)],
    }


def video_statistic(path: Path, frames: int) -> Statistic:
    """Of a video's pictures per channel in 0..1, shape (3, 1, 1), from an even subsample.

    Every frame is decoded on the way; raises RecordingError where there are not exactly `frames`.
    """
    import av

    wanted = set(np.linspace(0, frames - 1, min(frames, SAMPLED_PICTURES)).round().astype(int).tolist())
    sums = _ChannelSums()
    decoded = 0
    try:
        with av.open(str(path)) as container:
            for frame in container.decode(video=0):
                if decoded in wanted:
                    sums.add(np.asarray(frame.to_ndarray(format="rgb24"), dtype=np.uint8)[::2, ::2])
                decoded += 1
    except (av.FFmpegError, ValueError) as error:
        raise RecordingError(f"{path} cannot be decoded after frame {decoded}: {error}") from error
    if decoded != frames:
        raise RecordingError(f"{path} decodes to {decoded} frames, expected {frames}")
    return sums.statistic()


class _ChannelSums:
    def __init__(self) -> None:
        self._pictures = 0
        self._pixels = 0
        self._sum = np.zeros(3)
        self._squares = np.zeros(3)
        self._lowest = np.full(3, 255.0)
        self._highest = np.zeros(3)

    def add(self, picture: UInt8) -> None:
        pixels = picture.reshape(-1, 3).astype(np.float64)
        self._pictures += 1
        self._pixels += len(pixels)
        self._sum += pixels.sum(axis=0)
        self._squares += (pixels**2).sum(axis=0)
        self._lowest = np.minimum(self._lowest, pixels.min(axis=0))
        self._highest = np.maximum(self._highest, pixels.max(axis=0))

    def statistic(self) -> Statistic:
        mean = self._sum / self._pixels
        deviation = np.sqrt(np.maximum(self._squares / self._pixels - mean**2, 0.0))
        figures = {"min": self._lowest, "max": self._highest, "mean": mean, "std": deviation}
        scaled = {name: (value / 255).reshape(3, 1, 1).tolist() for name, value in figures.items()}
        return {**scaled, "count": [self._pictures]}


def aggregate(episodes: Iterable[Mapping[str, Statistic]]) -> dict[str, Statistic]:
    """The statistics of all episodes together, each episode weighted by its count.

    Source: the parallel form of the variance (Chan, Golub, LeVeque 1979).
    """
    collected: dict[str, list[Statistic]] = {}
    for statistics in episodes:
        for key, statistic in statistics.items():
            collected.setdefault(key, []).append(statistic)
    return {key: _together(parts) for key, parts in collected.items()}


def _together(parts: list[Statistic]) -> Statistic:
    means, deviations = (np.array([part[name] for part in parts], np.float64) for name in ("mean", "std"))
    counts = np.array([part["count"][0] for part in parts], np.float64)
    weights = (counts / counts.sum()).reshape(-1, *[1] * (means.ndim - 1))
    mean = (weights * means).sum(axis=0)
    variance = (weights * (deviations**2 + (means - mean) ** 2)).sum(axis=0)
    return {
        "min": np.array([part["min"] for part in parts]).min(axis=0).tolist(),
        "max": np.array([part["max"] for part in parts]).max(axis=0).tolist(),
        "mean": mean.tolist(),
        "std": np.sqrt(variance).tolist(),
        "count": [int(counts.sum())],
    }
