"""Chunks with which the policy answered in an episode: their times, delays and planned rows.

The times are those of the observation and of the chunk's arrival.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evaweb.core.binary_frames import Stream
from runtime.recording.reader import Episode

Array = NDArray[Any]
UNKNOWN = -1


def chunk_arrays(episode: Episode, times_of: Callable[[Array], Array]) -> Stream:
    """Return every chunk of the episode as a stream; `times_of` maps control steps to times [s].

    The stream has the list `strategies` and these arrays [C], in which -1 means unknown or none (older episodes have no
    overlap and no strategy):

    * id i4; rows i4: number of rows; first and last i4: the planned rows.
    * observed and arrived f8: times of the observation and of the arrival [s] (NaN: never arrived).
    * delay, mistimed and overlap i4 [steps].
    * strategy i4: index into `strategies`.
    * inference f4 [ms].
    """
    raw = episode.raw
    numbers, firsts, counts = np.unique(
        raw.column("chunk_id").to_numpy(), return_index=True, return_counts=True
    )
    heads = raw.take(firsts)
    observed, arrived = (heads.column(name).to_numpy() for name in ("observation_step", "arrival_step"))
    names, kinds = _strategies(heads)
    first, last = _planned(raw, numbers)
    columns = {
        "id": numbers,
        "rows": counts,
        "first": first,
        "last": last,
        "delay": np.where(arrived < 0, UNKNOWN, heads.column("delay").to_numpy()),
        "mistimed": heads.column("mistimed").to_numpy(),
        "overlap": heads.column("overlap").fill_null(UNKNOWN).to_numpy(),
        "strategy": kinds,
    }
    return Stream(
        json={"strategies": names},
        arrays={name: np.asarray(values).astype(np.int32) for name, values in columns.items()}
        | {
            "observed": times_of(observed),
            "arrived": np.where(arrived < 0, np.nan, times_of(arrived)),
            "inference": heads.column("inference_ms").to_numpy().astype(np.float32),
        },
    )


def _strategies(heads: Any) -> tuple[list[str], Array]:
    """Return the distinct kinds of strategies, and for each chunk the index of its kind (-1: unknown)."""
    kinds = [kind or "" for kind in heads.column("strategy").to_pylist()]
    names = sorted(set(kinds) - {""})
    return names, np.array([names.index(kind) if kind else UNKNOWN for kind in kinds], np.int32)


def _planned(raw: Any, numbers: Array) -> tuple[Array, Array]:
    """Return the first and the last row of each chunk that were planned for a step; -1 if no row was.

    `raw` is the table of the rows of all chunks, and `numbers` are the ids of the chunks in ascending order.
    """
    used = raw.filter(np.asarray(raw.column("target_step").to_numpy() >= 0))
    places = np.searchsorted(numbers, used.column("chunk_id").to_numpy())
    index = used.column("index").to_numpy()
    first = np.full(len(numbers), np.iinfo(np.int64).max)
    last = np.full(len(numbers), UNKNOWN)
    np.minimum.at(first, places, index)
    np.maximum.at(last, places, index)
    return np.where(last < 0, UNKNOWN, first), last
