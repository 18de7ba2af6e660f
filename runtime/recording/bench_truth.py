"""What a simulated bench says of itself, row by row: where its things lie and which milestones are reached."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

from runtime.core.errors import RecordingError

JUDGED = "milestones"
_KEPT = ("blocks", "plate", JUDGED)
_DECIMALS = 4  # a tenth of a millimetre: what lies still says the same in every row


def truth_text(truth: Mapping[str, Any]) -> str:
    """The part of a bench's truth that is recorded, as JSON; "" where it says nothing of it."""
    kept = {key: _rounded(truth[key]) for key in _KEPT if key in truth}
    return json.dumps(kept, separators=(",", ":")) if kept else ""


def truth_changes(rows: Any) -> list[tuple[int, dict[str, Any]]]:
    """(row, what the bench said from there on) of the column `bench` of rows.arrow; RecordingError for no such JSON.

    Empty where no bench said anything, as on every real one, in episodes from before there was the column and in those
    of datasets, which have none.
    """
    if "bench" not in rows.column_names:
        return []
    found = []
    for row, text in enumerate(rows.column("bench").to_pylist()):
        if text is None:
            continue
        try:
            said = json.loads(text)
        except ValueError as error:
            raise RecordingError(f"rows.arrow: bench of row {row} is no JSON: {error}") from error
        found.append((row, said if isinstance(said, dict) else {}))
    return found


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return round(value, _DECIMALS) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): _rounded(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(each) for each in value]
    return value
