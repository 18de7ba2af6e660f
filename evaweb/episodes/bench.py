"""Positions and milestones of a simulated bench in a recording, as the bench itself said them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from runtime.recording.bench_truth import JUDGED, truth_changes
from runtime.recording.reader import Episode, open_episode


def bench_course(folder: Path) -> list[dict[str, Any]]:
    """Where its things lay, [{row, blocks, plate}] from each row on in which that changed; without what is judged.

    Empty for a recording of no simulated bench. RecordingError names the file that is absent or damaged.
    """
    course: list[dict[str, Any]] = []
    for row, said in truth_changes(open_episode(folder).rows):
        lies = {key: value for key, value in said.items() if key != JUDGED}
        if not course or lies != {key: value for key, value in course[-1].items() if key != "row"}:
            course.append({"row": row, **lies})
    return course


def milestones_reached(episode: Episode) -> Iterator[tuple[str, int]]:
    """(name, row) of every milestone that the bench said was reached, at the first row in which it did."""
    known: set[str] = set()
    for row, said in truth_changes(episode.rows):
        reached = {name for name, yes in (said.get(JUDGED) or {}).items() if yes is True}
        for name in sorted(reached - known):
            yield name, row
        known |= reached
