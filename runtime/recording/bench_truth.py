"""Recorded ground truth of a simulated bench, by row: positions of its objects and reached milestones."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

from runtime.core.errors import RecordingError

JUDGED = "milestones"
_KEPT = ("blocks", "plate", "discs", "edges", "colours", "factors", "choices", "observation", JUDGED)
_DECIMALS = 4  # 0.1 mm, so that objects at rest yield the same text in every row


def truth_text(truth: Mapping[str, Any]) -> str:
    """Return the recorded part of a bench's ground truth as JSON; "" if there is none."""
    fields = {key: _rounded(truth[key]) for key in _KEPT if key in truth}
    return json.dumps(fields, separators=(",", ":")) if fields else ""


def truth_changes(rows: Any) -> list[tuple[int, dict[str, Any]]]:
    """Return (row, ground truth from that row on) for each change in the column `bench` of rows.arrow.

    Empty for real benches, for episodes older than the column, and for those of datasets, which lack it. Raises
    RecordingError for text that is not JSON.
    """
    if "bench" not in rows.column_names:
        return []
    changes = []
    for row, text in enumerate(rows.column("bench").to_pylist()):
        if text is None:
            continue
        try:
            truth = json.loads(text)
        except ValueError as error:
            raise RecordingError(f"rows.arrow: bench of row {row} is no JSON: {error}") from error
        changes.append((row, truth if isinstance(truth, dict) else {}))
    return changes


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return round(value, _DECIMALS) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): _rounded(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(item) for item in value]
    return value
