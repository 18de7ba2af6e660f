from pathlib import Path

import pytest

from runtime.core.errors import RecordingError
from runtime.recording.base import Outcome
from runtime.recording.episode import EpisodeJournal
from runtime.recording.reader import open_episode, read_events

from .samples import CAMERAS, SETTINGS, manifest, row, unsealed


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    journal = EpisodeJournal(tmp_path, SETTINGS)
    journal.begin(manifest())
    assert journal.folder is not None
    folder = journal.folder
    for k in range(5):
        journal.append(row(k))
    journal.end(Outcome("finished", "", 1.7e9))
    return folder


def test_rows_are_cut_to_what_the_outcome_says(folder: Path) -> None:
    unsealed(folder, frames=3)
    episode = open_episode(folder)
    assert episode.frames == 3
    assert episode.rows.column("index").to_pylist() == [0, 1, 2]


def test_fewer_rows_than_the_outcome_says_are_an_error(folder: Path) -> None:
    unsealed(folder, frames=6)
    with pytest.raises(RecordingError, match=r"rows\.arrow is damaged: 5 rows readable, its outcome says 6"):
        open_episode(folder)


@pytest.mark.parametrize("frames", [None, -1, True, "5"])
def test_an_outcome_without_a_count_is_an_error(folder: Path, frames: object) -> None:
    unsealed(folder, frames=frames)
    with pytest.raises(RecordingError, match=r"outcome\.json: frames is"):
        open_episode(folder)


def test_a_missing_video_is_named(folder: Path) -> None:
    (folder / f"{CAMERAS[1]}.mp4").unlink()
    with pytest.raises(RecordingError, match=f"{CAMERAS[1]}.mp4 is absent"):
        open_episode(folder)


def test_a_folder_that_is_no_episode_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"manifest\.json cannot be read"):
        open_episode(tmp_path)


def test_torn_and_strange_lines_are_counted(tmp_path: Path) -> None:
    (tmp_path / "events.jsonl").write_bytes(
        b'{"a": 1}\nnull\n{"b": \n{"c": 3}\n' + b"[" * 200_000 + b'\n{"d"'
    )
    found = read_events(tmp_path / "events.jsonl")
    assert found.lines == (b'{"a": 1}', b'{"c": 3}')
    assert found.torn == 4
    assert read_events(tmp_path / "absent").lines == ()
