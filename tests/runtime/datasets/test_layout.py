"""Metadata of a dataset: lines end at "\\n" alone, and every key is there once."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from runtime.core.errors import RecordingError
from runtime.datasets.layout import read_json, read_lines
from tests.runtime.datasets.odd_lines import ENDS_NO_LINE


@pytest.mark.parametrize("odd", ENDS_NO_LINE)
def test_a_task_with_any_character_is_one_line(tmp_path: Path, odd: str) -> None:
    tasks = [{"task_index": 0, "task": f"fold{odd}the cloth"}, {"task_index": 1, "task": odd}]
    (tmp_path / "tasks.jsonl").write_bytes(
        b"".join(json.dumps(task, ensure_ascii=False).encode() + b"\n" for task in tasks)
    )
    assert read_lines(tmp_path / "tasks.jsonl") == tasks


def test_lines_of_another_system_and_empty_ones_are_read_and_a_broken_one_is_named(tmp_path: Path) -> None:
    path = tmp_path / "episodes.jsonl"
    path.write_bytes(b'{"a": 1}\r\n\n{"a": 2}')
    assert read_lines(path) == [{"a": 1}, {"a": 2}]
    path.write_bytes(b'{"a": 1}\n{"a":\n')
    with pytest.raises(RecordingError, match="line 2 is no JSON"):
        read_lines(path)


@pytest.mark.parametrize(
    ("text", "why"),
    [('{"a": {"fps": 10, "fps": 50}}', "gives 'fps' twice"), ('{"a": ' + "[" * 100_000, "nested too deeply")],
)
def test_what_readers_would_take_differently_is_refused(tmp_path: Path, text: str, why: str) -> None:
    path = tmp_path / "info.json"
    path.write_text(text)
    for read in (read_json, read_lines):
        with pytest.raises(RecordingError, match=why):
            read(path)
