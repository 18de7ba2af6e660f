import errno
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from runtime.core.errors import RecordingError
from runtime.recording.files import (
    AppendFile,
    read_json,
    require_room,
    to_json,
    write_atomic,
)


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (errno.ENOSPC, "disk full while writing"),
        (errno.EFBIG, "file too large while writing"),
        (errno.EIO, "disk error while writing"),
    ],
)
def test_half_a_write_is_cut_away_and_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int, words: str
) -> None:
    file = AppendFile(tmp_path / "rows.arrow")
    file.write(b"whole")
    real, calls = os.write, []

    def failing(descriptor: int, data: memoryview) -> int:
        calls.append(len(data))
        if len(calls) > 1:
            raise OSError(code, os.strerror(code))
        return real(descriptor, data[:3])

    monkeypatch.setattr(os, "write", failing)
    with pytest.raises(RecordingError, match=words) as raised:
        file.write(b"torn in the middle")
    monkeypatch.undo()
    assert "rows.arrow" in str(raised.value)
    assert f"bytes free in {tmp_path}" in str(raised.value)
    assert os.strerror(code) in str(raised.value)
    file.write(b" again")
    file.sync()
    file.close()
    assert (tmp_path / "rows.arrow").read_bytes() == b"whole again"
    assert calls == [18, 15]


def test_a_write_that_comes_in_pieces_is_completed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = AppendFile(tmp_path / "a")
    real = os.write
    monkeypatch.setattr(os, "write", lambda descriptor, data: real(descriptor, data[:2]))
    file.write(bytearray(b"seven b"))
    monkeypatch.undo()
    file.close()
    assert (tmp_path / "a").read_bytes() == b"seven b"
    assert file.size == 7


def test_a_sync_that_fails_is_an_error_and_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = AppendFile(tmp_path / "a")
    file.write(b"x")
    synced: list[int] = []

    def failing(descriptor: int) -> None:
        synced.append(descriptor)
        if len(synced) == 1:
            raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(os, "fdatasync", failing)
    with pytest.raises(RecordingError, match="disk error while syncing"):
        file.sync()
    file.sync()
    file.sync()  # nothing new: the disk is not asked
    file.close()
    assert len(synced) == 2


def test_an_existing_file_is_never_written_again(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"old")
    with pytest.raises(RecordingError, match="creating"):
        AppendFile(tmp_path / "a")
    assert (tmp_path / "a").read_bytes() == b"old"


def test_a_document_that_cannot_be_written_leaves_the_old_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_atomic(tmp_path / "outcome.json", b"old")

    def failing(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", failing)
    with pytest.raises(RecordingError, match=r"disk full while writing .*outcome\.json"):
        write_atomic(tmp_path / "outcome.json", b"new")
    assert (tmp_path / "outcome.json").read_bytes() == b"old"
    assert [path.name for path in tmp_path.iterdir()] == ["outcome.json"]


def test_too_little_room_says_how_much_there_is_how_much_is_wanted_and_where(tmp_path: Path) -> None:
    wanted = shutil.disk_usage(tmp_path).total + 1
    with pytest.raises(RecordingError, match=r"\d+ bytes free") as raised:
        require_room(tmp_path / "not" / "yet", wanted)
    assert str(wanted) in str(raised.value)
    assert str(tmp_path) in str(raised.value)


def test_numpy_values_become_plain_and_unknown_numbers_null() -> None:
    value = {"a": np.float32(1.5), "b": np.arange(2), "c": float("nan"), "d": (1, np.inf), "e": Path("x")}
    assert json.loads(to_json(value, "an event")) == {
        "a": 1.5,
        "b": [0, 1],
        "c": None,
        "d": [1, None],
        "e": "x",
    }


def test_a_value_that_json_does_not_know_is_named() -> None:
    with pytest.raises(RecordingError, match=r"an event cannot be written as JSON.*object"):
        to_json({"a": object()}, "an event")


@pytest.mark.parametrize("content", [b'{"a": ', b"", b"\xff\xfe", b"[1]"])
def test_a_torn_document_is_an_error_that_names_it(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "manifest.json").write_bytes(content)
    with pytest.raises(RecordingError, match=r"manifest\.json"):
        read_json(tmp_path / "manifest.json")
