"""What is in the lab's store is never taken for lost, however its index is found."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from runtime.core.errors import RecordingError
from runtime.recording.archive_index import index_file, require_not_stored, stored_files, write_index

UUID = "00000000-0000-4000-8000-000000000001"
FILES = {"front.mp4": "ab" * 32}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "episodes" / UUID
    folder.mkdir(parents=True)
    return folder


def test_the_folder_may_be_named_by_any_path(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_index(folder.parents[1], UUID, FILES)
    monkeypatch.chdir(folder)
    assert stored_files(folder) == stored_files(Path()) == FILES
    with pytest.raises(RecordingError, match=f"archive --back {UUID} brings"):
        require_not_stored(Path("front.mp4"))


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "{}", '{"files": {}}', '{"files": {"a/b.mp4": "%s"}}' % ("ab" * 32)]
)
def test_an_index_that_names_no_videos_is_an_error_and_not_an_absent_one(folder: Path, text: str) -> None:
    path = index_file(folder.parents[1], UUID)
    path.parent.mkdir()
    path.write_text(text)
    with pytest.raises(RecordingError, match=str(path)):
        stored_files(folder)


def test_an_index_that_may_not_be_looked_at_is_there(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path) -> os.stat_result:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "lstat", refuse)
    with pytest.raises(RecordingError, match="Permission denied"):
        stored_files(folder)


@pytest.mark.parametrize(
    "files", [{}, {"../other/front.mp4": "ab" * 32}, {"front.mkv": "ab" * 32}, {"front.mp4": "ab"}]
)
def test_no_index_is_written_that_could_not_be_read(folder: Path, files: dict[str, str]) -> None:
    with pytest.raises(RecordingError, match="cannot name"):
        write_index(folder.parents[1], UUID, files)
    assert stored_files(folder) == {}
