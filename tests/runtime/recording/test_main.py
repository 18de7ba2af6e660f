import shutil
from pathlib import Path

import pytest

from runtime.recording.__main__ import main
from runtime.recording.base import Outcome
from runtime.recording.episode import EpisodeJournal

from .samples import CAMERAS, SETTINGS, chunk, manifest, row, tick, unended


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    journal = EpisodeJournal(tmp_path, SETTINGS)
    journal.begin(manifest())
    assert journal.folder is not None
    folder = journal.folder
    for k in range(3):
        journal.append(row(k))
        journal.append(tick(k))
    journal.append(chunk(1))
    journal.append_event({"kind": "started"})
    journal.end(Outcome("finished", "done", 1.7e9))
    return folder


def test_show_says_what_an_episode_holds(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["show", str(folder)]) == 0
    shown = capsys.readouterr().out
    for words in (
        folder.name,
        "stack the blocks",
        "finished (done)",
        "3 at 30 Hz",
        "4 rows of chunks",
        CAMERAS[0],
    ):
        assert words in shown


def test_repair_mends_one_or_all(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    unended(folder)
    assert main(["repair", str(folder)]) == 0
    assert "repaired: 3 rows" in capsys.readouterr().out
    unended(folder)
    assert main(["repair", str(folder.parent)]) == 0
    said = capsys.readouterr().out
    assert "repaired: 3 rows" in said
    assert "its outcome is lost" in said
    (folder / "outcome.json").unlink()
    assert main(["repair", str(folder.parent)]) == 0
    assert "restored: it has no outcome, and a whole copy of it" in capsys.readouterr().out
    assert main(["show", str(folder)]) == 0
    assert "interrupted" in capsys.readouterr().out


def test_what_cannot_be_read_ends_with_code_one(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.rmtree(folder)
    folder.mkdir()
    assert main(["show", str(folder)]) == 1
    assert "manifest.json" in capsys.readouterr().err
    assert main(["repair", str(folder.parent)]) == 1
    assert "unreadable" in capsys.readouterr().out
    assert main(["repair", str(folder / "absent")]) == 1


def test_export_writes_one_or_all_into_the_data_folder_that_they_lie_in(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = folder.parent / "data"
    placed = Path(shutil.copytree(folder, data / "episodes" / folder.name))
    for given in (placed, placed.parent):
        assert main(["export", str(given)]) == 0
        path = Path(capsys.readouterr().out.strip())
        assert path.is_relative_to(data / "exports")
        assert path.is_file()


def test_export_goes_on_behind_one_that_fails(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    broken = Path(shutil.copytree(folder, folder.with_name("aaa")))
    (broken / "outcome.json").unlink()
    assert main(["export", str(broken), str(folder), "--to", str(folder.parent / "data")]) == 1
    said = capsys.readouterr()
    assert "aaa has no outcome.json" in said.err
    assert said.out.strip().endswith(f"{folder.name}.parquet")


@pytest.mark.parametrize(
    ("path", "sentence"),
    [("", "say where to export to with --to DATA"), ("..", "is no episode"), ("absent", "is no folder")],
)
def test_export_says_what_it_cannot_do(
    folder: Path, capsys: pytest.CaptureFixture[str], path: str, sentence: str
) -> None:
    (folder.parent / "empty").mkdir()
    given = folder.parent / "empty" if path == ".." else folder / path
    assert main(["export", str(given)]) == 1
    assert sentence in capsys.readouterr().err
