"""Rule of all strategies for the assignment of a chunk's rows to control steps."""

from __future__ import annotations

import numpy as np

from runtime.ipc.messages import MergeResult
from runtime.strategies.base import ArrivedChunk, Placement


def place(
    arrival: ArrivedChunk, free_step: int, horizon: int | None = None, k_max: int | None = None
) -> Placement:
    """Assign row i to step observation_step + i, and drop rows for steps before `free_step` as stale.

    Only the first `horizon` rows are used. At most `k_max` rows are dropped as stale: if more would be, the chunk is
    shifted to later steps, which counts as mistimed. A chunk that was requested while the robot was stopped starts at
    `free_step` with row 0. A chunk whose rows are all for past steps is dropped, whatever `k_max` is. A chunk that
    arrives before the step of its observation (which was estimated too high) starts at once.
    """
    delay = free_step - arrival.observation_step
    count = len(arrival.rows) if horizon is None else min(horizon, len(arrival.rows))
    due = 0 if arrival.requested_while_stopped else delay
    if due >= count:
        return drop(arrival, free_step, _stale_rows(delay, count, len(arrival.rows)))
    stale = max(0, due if k_max is None else min(due, k_max))
    targets = np.full(len(arrival.rows), -1, np.int64)
    targets[stale:count] = free_step + np.arange(count - stale)
    merged = MergeResult(arrival.chunk_id, free_step, delay, targets, mistimed=due - stale)
    before = arrival.rows[stale - 1] if stale else None
    return Placement(arrival.rows[stale:count], merged, before)


def drop(arrival: ArrivedChunk, free_step: int, why: str) -> Placement:
    """Return the placement of a chunk that is not used, with the reason `why`."""
    nowhere = np.full(len(arrival.rows), -1, np.int64)
    delay = free_step - arrival.observation_step
    return Placement(arrival.rows[:0], MergeResult(arrival.chunk_id, free_step, delay, nowhere, dropped=why))


def _stale_rows(delay: int, count: int, rows: int) -> str:
    used = (
        f"its {rows} rows"
        if count == rows
        else f"the first {count} of its {rows} rows, its execution horizon,"
    )
    return f"arrived {delay} steps after its observation, {used} are all in the past"
