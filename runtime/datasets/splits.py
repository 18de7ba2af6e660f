"""Splits of info.json: which episodes are for training, and which for other purposes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from runtime.core.errors import RecordingError

TRAIN = "train"  # default split of every episode, as in LeRobot


def episodes_of(name: str, value: Any) -> list[int]:
    """Return the indices of a split's episodes; `value` is "0:40", "0:3,5:8,9" or a list of numbers.

    Raises: RecordingError if it is invalid.
    """
    try:
        if isinstance(value, str):
            return [index for part in value.split(",") if part.strip() for index in _range(part)]
        return [index for item in value for index in _range(str(item))]
    except (TypeError, ValueError):
        raise RecordingError(
            f"split {name!r} is {value!r:.80}, expected episodes such as '0:40' or '0:3,5:8'"
        ) from None


def written(splits: Mapping[str, Iterable[int]]) -> dict[str, str]:
    """Return splits as info.json has them: half-open ranges, separated by commas; empty splits are omitted."""
    return {name: text for name, indices in splits.items() if (text := _text(sorted(set(indices))))}


def with_more(splits: Mapping[str, Any], first: int, end: int) -> dict[str, Any]:
    """Return `splits` with the episodes from `first` to before `end` added for training.

    Raises: RecordingError if the present split for training is invalid.
    """
    if first >= end:
        return dict(splits)
    training = episodes_of(TRAIN, splits.get(TRAIN, ""))
    return {**splits, **written({TRAIN: [*training, *range(first, end)]})}


def _range(part: str) -> Sequence[int]:
    first, colon, end = part.strip().partition(":")
    indices = range(int(first), int(end)) if colon else [int(first)]
    if int(first) < 0 or len(indices) > 10_000_000:
        raise ValueError(part)
    return indices


def _text(indices: Sequence[int]) -> str:
    runs: list[list[int]] = []
    for index in indices:
        if runs and runs[-1][1] == index:
            runs[-1][1] = index + 1
        else:
            runs.append([index, index + 1])
    return ",".join(f"{first}:{end}" for first, end in runs)
