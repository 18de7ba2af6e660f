"""A label is one line, whatever characters its note has."""

from __future__ import annotations

import json
import uuid
from pathlib import Path

import pytest

from runtime.recording.labels import FOLDER, Label, append_label, latest_label, read_labels
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
        append_label(tmp_path, episode, label)
    assert read_labels(tmp_path, episode) == said
    assert latest_label(tmp_path, episode) == said[-1]


def test_a_label_after_a_byte_order_mark_counts(tmp_path: Path) -> None:
    episode = "00000000-0000-4000-8000-000000000001"
    path = tmp_path / FOLDER / f"{episode}.jsonl"
    path.parent.mkdir()
    line = {"time": 1.0, "by": "ann", "result": None, "note": "", "discarded": True}
    path.write_text("\ufeff" + json.dumps(line) + "\n", "utf-8")
    assert [label.discarded for label in read_labels(tmp_path, episode)] == [True]
