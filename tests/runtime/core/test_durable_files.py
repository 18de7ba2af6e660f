"""Files that are whole or not there: what a full disk, a kill and a second writer leave."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

import pytest

from runtime.core.durable_files import (
    AppendError,
    append_durably,
    create_durably,
    creating_durably,
    write_durably,
)


def test_a_file_is_replaced_whole_and_has_the_mode_that_was_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "key"
    (tmp_path / ".key.draft").write_bytes(b"left by a kill, and longer")
    write_durably(path, b"first", 0o600)
    write_durably(path, b"2nd", 0o600)

    assert path.read_bytes() == b"2nd"
    assert stat.S_IMODE(path.stat().st_mode) & 0o077 == 0
    assert [entry.name for entry in tmp_path.iterdir()] == ["key"]


def test_a_file_that_exists_is_not_created_again(tmp_path: Path) -> None:
    path = tmp_path / "key"
    create_durably(path, b"first")
    create_durably(path, b"second")

    assert path.read_bytes() == b"first"
    assert [entry.name for entry in tmp_path.iterdir()] == ["key"]


@pytest.mark.parametrize("has_links", [True, False])
def test_a_file_written_piece_by_piece_appears_whole_and_replaces_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, has_links: bool
) -> None:
    def link(draft: Path, path: Path) -> None:
        raise OSError(errno.EPERM, os.strerror(errno.EPERM))

    if not has_links:
        monkeypatch.setattr(os, "link", link)
    path = tmp_path / "long"
    (tmp_path / ".long.draft").write_bytes(b"left by a kill, and longer")
    with creating_durably(path) as file:
        file.write(b"one, ")
        assert file.tell() == 5
        assert not path.exists()
        file.write(b"two")
    with pytest.raises(FileExistsError), creating_durably(path) as file:
        file.write(b"other")
    with pytest.raises(TypeError), creating_durably(tmp_path / "none") as file:
        file.writelines([b"half", "no bytes"])

    assert path.read_bytes() == b"one, two"
    assert [entry.name for entry in tmp_path.iterdir()] == ["long"]


def test_a_full_disk_leaves_the_old_file_and_no_draft(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "pin"
    path.write_bytes(b"old")

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    for write in (write_durably, create_durably):
        with pytest.raises(OSError, match="No space left"):
            write(path, b"new")

    assert path.read_bytes() == b"old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["pin"]


def test_a_torn_line_is_ended_before_the_next_and_a_failed_one_is_undone(tmp_path: Path) -> None:
    path = tmp_path / "lines"
    path.write_bytes(b"one\ntorn")

    def broken(descriptor: int) -> None:
        raise OSError(5, "Input/output error")

    with path.open("a+b", buffering=0) as file:
        append_durably(file, b"two\n")
        append_durably(file, b"three\n")
        with pytest.raises(AppendError, match="Input/output error") as refused:
            append_durably(file, b"four\n", broken)

    assert refused.value.is_restored
    assert path.read_bytes() == b"one\ntorn\ntwo\nthree\n"
