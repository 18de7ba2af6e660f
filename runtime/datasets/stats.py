"""Statistics of an episode's columns and images, and of all episodes, in LeRobot's form."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.core.errors import RecordingError
from runtime.core.picture_bounds import open_video
from runtime.core.types import UInt8
from runtime.datasets.video_frames import StoredImages

# min, max, mean, std, quantiles: lists of the feature's shape; count: [n]
Statistic = dict[str, list[Any]]
QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
FIGURES = ("min", "max", "mean", "std")  # required figures of a statistic, besides its count
SAMPLED_PICTURES = 100  # images sampled per video and episode


def column_statistic(values: NDArray[Any]) -> Statistic | None:
    """Return the statistic of a column [N] or [N, ...] over its finite rows; None if there are none.

    The standard deviation is that of the population.
    """
    rows = values if values.ndim > 1 else values.reshape(-1, 1)
    finite_rows = rows[finite(rows)]
    if not finite_rows.size:
        return None
    exact = finite_rows.astype(np.float64)
    quantiles = np.quantile(exact, list(QUANTILES.values()), axis=0)
    return {
        "min": finite_rows.min(axis=0).tolist(),
        "max": finite_rows.max(axis=0).tolist(),
        "mean": exact.mean(axis=0).tolist(),
        "std": exact.std(axis=0).tolist(),
        "count": [len(finite_rows)],
        **dict(zip(QUANTILES, quantiles.tolist(), strict=True)),
    }


def finite(rows: NDArray[Any]) -> NDArray[np.bool_]:
    """Return bool [N]: which rows of [N, ...] have only finite values."""
    good: NDArray[np.bool_] = np.isfinite(rows).all(axis=tuple(range(1, rows.ndim)))
    return good


def fault(statistic: object, shapes: Sequence[tuple[int, ...]]) -> str:
    """Return why a statistic is unusable, "" if it is usable.

    Each of the figures in it, such as the mean, must be finite and have one of `shapes`.
    """
    if not isinstance(statistic, Mapping):
        return f"is {statistic!r:.80}, expected {', '.join(FIGURES)} and count"
    for name in FIGURES + tuple(name for name in QUANTILES if name in statistic):
        if name not in statistic:
            return f"has no {name}"
        try:
            figure = np.asarray(statistic[name], np.float64)
        except (TypeError, ValueError):
            return f"{name} is {statistic[name]!r:.80}, expected numbers"
        if figure.shape not in shapes:
            return f"{name} has shape {figure.shape}, expected {' or '.join(map(str, shapes))}"
        if not np.isfinite(figure).all():
            return f"{name} is {statistic[name]!r:.80}, expected finite numbers"
    count = statistic.get("count")
    (rows,) = count if isinstance(count, Sequence) and len(count) == 1 else (None,)
    if isinstance(rows, bool) or not isinstance(rows, int | float) or not 0 < rows < np.inf:
        return f"count is {count!r:.80}, expected [n] of the rows that it is of"
    return ""


def video_statistic(path: Path, frames: int) -> Statistic:
    """Return the statistic of a video's images per channel in 0..1, shape (3, 1, 1), from an even subsample.

    Depth of more than 8 bits is used with its full bit depth. Every frame is decoded.

    Raises:
        RecordingError: The video does not have exactly `frames` frames or cannot be decoded.
    """
    import av

    sampled = set(np.linspace(0, frames - 1, min(frames, SAMPLED_PICTURES)).round().astype(int).tolist())
    sums, deep = _Histogram(), _Deep()
    decoded = 0
    try:
        with open_video(path) as container:
            for frame in container.decode(video=0):
                if decoded in sampled:
                    (bits, *further_bits) = (component.bits for component in frame.format.components)
                    if bits > 8 and not further_bits:
                        deep.add(frame.to_ndarray()[::2, ::2] / (2.0**bits - 1))
                    else:
                        sums.add(np.asarray(frame.to_ndarray(format="rgb24"), dtype=np.uint8)[::2, ::2])
                decoded += 1
    except (av.FFmpegError, ValueError) as error:
        raise RecordingError(f"{path} cannot be decoded after frame {decoded}: {error}") from error
    if decoded != frames:
        raise RecordingError(f"{path} decodes to {decoded} frames, expected {frames}")
    statistic = deep.statistic() if deep else sums.statistic()
    if statistic is None:
        raise RecordingError(f"{path}: there is no number in its pictures")
    return statistic


def picture_statistic(pictures: StoredImages) -> Statistic | None:
    """Return the statistic that `video_statistic` returns, for images stored one by one.

    None if all images are missing or no value is finite. Missing images are skipped. Depth of 16 bits is divided by
    65535, floats are used unchanged.
    """
    present = [number for number in range(len(pictures)) if not pictures.is_missing(number)]
    sums, deep = _Histogram(), _Deep()
    for place in np.unique(
        np.linspace(0, len(present) - 1, min(len(present), SAMPLED_PICTURES)).round().astype(int)
    ):
        depth = pictures.depth(present[place])
        if depth is not None:
            deep.add(depth[::2, ::2])
        else:
            sums.add(pictures[present[place]][::2, ::2])
    return (deep.statistic() if deep else sums.statistic()) if present else None


class _Deep:
    """Statistic of depth images: computed per image and then merged, so that they need not fit into memory."""

    def __init__(self) -> None:
        self._each: list[Statistic] = []
        self._pictures = 0

    def __bool__(self) -> bool:
        return self._pictures > 0

    def add(self, depth: NDArray[np.floating[Any]]) -> None:
        """Add an image [H, W] whose values are shares of the full scale."""
        self._pictures += 1
        statistic = column_statistic(depth.reshape(-1))
        if statistic is not None:
            self._each.append(statistic)

    def statistic(self) -> Statistic | None:
        """Return the statistic with the single channel repeated three times, as LeRobot expects; None if no value is
        finite.
        """
        if not self._each:
            return None
        together = _merge_statistics(self._each)
        return {
            name: [self._pictures] if name == "count" else [[list(figure)]] * 3
            for name, figure in together.items()
        }


class _Histogram:
    """Counts of the values 0 to 255 per channel, from which every statistic follows exactly."""

    def __init__(self) -> None:
        self._pictures = 0
        self._counts = np.zeros((3, 256), dtype=np.int64)

    def add(self, picture: UInt8) -> None:
        self._pictures += 1
        for channel in range(3):
            self._counts[channel] += np.bincount(picture[..., channel].reshape(-1), minlength=256)

    def statistic(self) -> Statistic:
        values = np.arange(256, dtype=np.float64)
        pixels = self._counts[0].sum()
        mean = self._counts @ values / pixels
        variance = np.maximum(self._counts @ values**2 / pixels - mean**2, 0.0)
        reached = self._counts.cumsum(axis=1)
        figures = {
            "min": (self._counts > 0).argmax(axis=1),
            "max": 255 - (self._counts[:, ::-1] > 0).argmax(axis=1),
            "mean": mean,
            "std": np.sqrt(variance),
        }
        figures |= {name: (reached >= share * pixels).argmax(axis=1) for name, share in QUANTILES.items()}
        scaled = {
            name: (np.asarray(value, np.float64) / 255).reshape(3, 1, 1).tolist()
            for name, value in figures.items()
        }
        return {**scaled, "count": [self._pictures]}


def aggregate_statistics(episodes: Iterable[Mapping[str, Statistic]]) -> dict[str, Statistic]:
    """Return the statistics of all episodes together, each episode weighted by its count.

    Source: parallel form of the variance (Chan, Golub, LeVeque 1979). A quantile is the weighted mean of the episodes'
    quantiles, as in LeRobot; it is omitted if an episode lacks it.

    Raises:
        ValueError: A count is not above 0.
    """
    collected: dict[str, list[Statistic]] = {}
    for statistics in episodes:
        for key, statistic in statistics.items():
            collected.setdefault(key, []).append(statistic)
    return {key: _merge_statistics(parts) for key, parts in collected.items()}


def _merge_statistics(parts: list[Statistic]) -> Statistic:
    means, deviations = (np.array([part[name] for part in parts], np.float64) for name in ("mean", "std"))
    counts = np.array([part["count"][0] for part in parts], np.float64)
    if not (counts > 0).all():
        raise ValueError(f"counts are {counts.tolist()}, expected all above 0")
    weights = (counts / counts.sum()).reshape(-1, *[1] * (means.ndim - 1))
    mean = (weights * means).sum(axis=0)
    variance = (weights * (deviations**2 + (means - mean) ** 2)).sum(axis=0)
    return {
        "min": np.array([part["min"] for part in parts]).min(axis=0).tolist(),
        "max": np.array([part["max"] for part in parts]).max(axis=0).tolist(),
        "mean": mean.tolist(),
        "std": np.sqrt(variance).tolist(),
        "count": [int(counts.sum())],
        **{
            name: (weights * np.array([part[name] for part in parts], np.float64)).sum(axis=0).tolist()
            for name in QUANTILES
            if all(name in part for part in parts)
        },
    }
