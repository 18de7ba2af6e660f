from __future__ import annotations

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from benchmarks import __main__ as command_line
from benchmarks.report import Figure, Report


@pytest.fixture(autouse=True)
def measured(monkeypatch: pytest.MonkeyPatch) -> Report:
    report = Report("ik", [Figure("chunk_ms", 0.25, "ms", "<= 0.5")], [])
    module = SimpleNamespace(measure=lambda seconds: report)
    monkeypatch.setattr(command_line, "importlib", SimpleNamespace(import_module=lambda name: module))
    return report


def run(monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    monkeypatch.setattr(sys, "argv", ["benchmarks", "ik", *words])
    return command_line.main()


def test_json_without_a_file_is_printed_alone(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "--json") == 0
    assert json.loads(capsys.readouterr().out)["figures"][0]["name"] == "chunk_ms"


def test_json_goes_to_a_file_beside_the_printed_table(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, measured: Report
) -> None:
    assert run(monkeypatch, "--json", str(tmp_path / "out.json")) == 0
    assert json.loads((tmp_path / "out.json").read_text("utf-8"))["figures"][0]["value"] == 0.25
    assert capsys.readouterr().out == measured.table() + "\n"
