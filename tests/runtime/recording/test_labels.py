"""A label is one line, whatever characters its note has."""

from __future__ import annotations

import uuid
from pathlib import Path

import pytest

from runtime.recording.labels import Label, append, labels, newest
from tests.runtime.datasets.odd_lines import ENDS_NO_LINE


@pytest.mark.parametrize("odd", ENDS_NO_LINE)
def test_what_only_some_programs_take_for_the_end_of_a_line_ends_none(tmp_path: Path, odd: str) -> None:
    episode = str(uuid.uuid4())
    said = [
        Label(1.0, "ann", "success"),
        Label(2.0, f"ann{odd}", "fail", f"slipped{odd}twice"),
        Label(3.0, "ann", "fail", odd, discarded=True),
    ]
    for label in said:
        append(tmp_path, episode, label)
    assert labels(tmp_path, episode) == said
    assert newest(tmp_path, episode) == said[-1]
