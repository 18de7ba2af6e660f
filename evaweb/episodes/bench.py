"""Ground truth of a simulated bench in a recording: positions of objects, and milestones."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from runtime.recording.bench_truth import JUDGED, truth_changes
from runtime.recording.reader import Episode, open_episode


def bench_course(folder: Path) -> list[dict[str, Any]]:
    """Return the positions of the objects as [{row, blocks, plate}], one entry for each row where a position changed.

    The outcome of the run is omitted. The list is empty for a recording without simulated bench. Raises:
    RecordingError, which names the absent or damaged file.
    """
    course: list[dict[str, Any]] = []
    for row, change in truth_changes(open_episode(folder, videos=False).rows):
        lies = {key: value for key, value in change.items() if key != JUDGED}
        if not course or lies != {key: value for key, value in course[-1].items() if key != "row"}:
            course.append({"row": row, **lies})
    return course


def milestones_reached(episode: Episode) -> Iterator[tuple[str, int]]:
    """Yield (name, row) of every milestone that the ground truth reports; `row` is the first at which it is reached."""
    reached_before: set[str] = set()
    for row, change in truth_changes(episode.rows):
        reached = {name for name, yes in (change.get(JUDGED) or {}).items() if yes is True}
        for name in sorted(reached - reached_before):
            yield name, row
        reached_before |= reached
