"""The Croissant description of a dataset says what its files are, and other people's programs read its rows."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest

from runtime.datasets.__main__ import main
from tests.runtime.datasets.foreign import Plan, write


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    write(tmp_path / "cups", Plan("v3.0", lengths=(4, 5), videos=()))
    return tmp_path / "cups"


def described(dataset: Path, capsys: pytest.CaptureFixture[str]) -> dict[str, object]:
    own = ["--licence", "cc-by-4.0", "--url", "https://lab.example.org/cups"]
    assert main(["croissant", str(dataset), *own]) == 0
    found: dict[str, object] = json.loads(capsys.readouterr().out)
    return found


def test_every_file_is_named_with_its_digest_and_every_column_with_its_type(
    dataset: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = described(dataset, capsys)
    assert (found["name"], found["version"]) == ("cups", "3.0.0")
    assert found["license"] == "https://spdx.org/licenses/CC-BY-4.0"
    objects = {row["@id"]: row for row in found["distribution"] if row["@type"] == "cr:FileObject"}  # type: ignore[attr-defined]
    real = {path.relative_to(dataset).as_posix(): path for path in dataset.rglob("*.*") if path.is_file()}
    real = {name: path for name, path in real.items() if not path.name.startswith(".")}
    assert set(objects) == set(real)
    for name, path in real.items():
        assert objects[name]["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
    fields = {row["name"]: row for row in found["recordSet"][0]["field"]}  # type: ignore[index]
    assert fields["rows/action"]["dataType"] == "sc:Float"
    assert fields["rows/action"]["repeated"] is True
    assert "repeated" not in fields["rows/timestamp"]
    assert fields["rows/index"]["dataType"] == "sc:Integer"


def test_mlcroissant_reads_it(dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mlcroissant = pytest.importorskip("mlcroissant", reason="mlcroissant is not installed: it brings pandas")
    file = dataset / "croissant.json"
    file.write_text(json.dumps(described(dataset, capsys)))
    opened = mlcroissant.Dataset(str(file))
    assert "error" not in opened.metadata.ctx.issues.report()
    assert len(list(opened.records("rows"))) == 9


def test_a_description_needs_a_licence_that_has_an_address(dataset: Path) -> None:
    with pytest.raises(SystemExit):
        main(["croissant", str(dataset), "--licence", "other", "--url", "https://lab.example.org"])
