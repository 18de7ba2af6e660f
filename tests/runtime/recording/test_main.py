import shutil
from pathlib import Path

import pytest

from runtime.recording.__main__ import main
from runtime.recording.base import Outcome
from runtime.recording.episode import EpisodeJournal

from .samples import CAMERAS, SETTINGS, chunk, manifest, row, tick


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
    journal.mark({"kind": "started"})
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
    (folder / "outcome.json").unlink()
    assert main(["repair", str(folder)]) == 0
    assert "repaired: 3 rows" in capsys.readouterr().out
    (folder / "outcome.json").unlink()
    assert main(["repair", str(folder.parent)]) == 0
    assert "repaired: 3 rows" in capsys.readouterr().out
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
