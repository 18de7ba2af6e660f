"""Copies of files that change while they are copied, and what of a data folder is in no backup."""

from __future__ import annotations

import errno
import os
import socket
from collections.abc import Iterator

import pytest

from evaweb.lab.backups import file_copies
from evaweb.lab.backups.errors import BackupError
from evaweb.lab.backups.file_copies import FileCopies, read_list, write_list

EPISODE = "episodes/0b7c"


@pytest.fixture
def data(tmp_path):
    folder = tmp_path / "data"
    for name, text in {
        "secret_key": "key",
        f"{EPISODE}/aligned.arrow": "rows",
        f"{EPISODE}/outcome.json": "{}",
        "scores/0b7c.jsonl": "a line\n",
        "stations/bench/commands.jsonl": "a command\n",
    }.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


def copies(data, target, before=None, without=()):
    target.mkdir(parents=True)
    made = FileCopies(data, target, before, without)
    return made, list(made.copy())


def test_every_file_is_copied_and_listed_but_what_one_machine_makes_anew(data, tmp_path, monkeypatch):
    for name in (
        "logs/web.log",
        "lab.lock",
        "stations/bench/bus.key",
        "stations/bench/endpoints/control",
        "cache/object",
        "eva.sqlite3",
    ):
        (data / name).parent.mkdir(parents=True, exist_ok=True)
        (data / name).write_text("ours")
    (data / "scores" / "latest").symlink_to("0b7c.jsonl")
    with socket.socket(socket.AF_UNIX) as listener:
        monkeypatch.chdir(data)  # a path of a socket is short
        listener.bind("door")
        made, listed = copies(data, tmp_path / "copy", without=[data / "eva.sqlite3"])
    assert {each.path for each in listed} == {
        "secret_key",
        f"{EPISODE}/aligned.arrow",
        f"{EPISODE}/outcome.json",
        "scores/0b7c.jsonl",
        "scores/latest",
        "stations/bench/commands.jsonl",
    }
    for each in listed:
        assert (tmp_path / "copy" / each.path).read_bytes() == (data / each.path).read_bytes()
    assert made.changing == []
    write_list(tmp_path / "list", listed)
    assert list(read_list(tmp_path / "list")) == listed


def test_what_has_not_changed_is_shared_with_the_backup_before(data, tmp_path):
    _, first = copies(data, tmp_path / "first")
    (data / "scores/0b7c.jsonl").write_text("a line\nand another\n")
    before = (tmp_path / "first", {each.path: each for each in first})
    made, second = copies(data, tmp_path / "second", before)
    assert made.linked == len(first) - 1
    shared = {
        each.path: os.path.samefile(tmp_path / "first" / each.path, tmp_path / "second" / each.path)
        for each in second
    }
    assert [path for path, same in shared.items() if not same] == ["scores/0b7c.jsonl"]
    assert (tmp_path / "first/scores/0b7c.jsonl").read_text() == "a line\n"


def after_each_copy(monkeypatch, change):
    """Let `change` happen after each file that is copied."""
    copied = file_copies.copied

    def slowly(source, target, name):
        done = copied(source, target, name)
        change(name)
        return done

    monkeypatch.setattr(file_copies, "copied", slowly)


def test_a_recording_that_closes_meanwhile_is_copied_whole_or_open_never_sealed_and_short(
    data, tmp_path, monkeypatch
):
    (data / EPISODE / "outcome.json").unlink()
    ends: Iterator[str] = iter(["aligned.arrow"])

    def close(name):
        if name.startswith(EPISODE) and next(ends, None):
            with (data / EPISODE / "aligned.arrow").open("a") as rows:
                rows.write(", the last")
            (data / EPISODE / "outcome.json").write_text("{}")

    after_each_copy(monkeypatch, close)
    made, listed = copies(data, tmp_path / "copy")
    assert made.changing == []
    assert {each.path for each in listed} >= {f"{EPISODE}/aligned.arrow", f"{EPISODE}/outcome.json"}
    assert (tmp_path / "copy" / EPISODE / "aligned.arrow").read_text() == "rows, the last"


def test_a_recording_that_goes_on_has_no_seal_and_is_named(data, tmp_path, monkeypatch):
    (data / EPISODE / "outcome.json").unlink()

    def record(name):
        if name == f"{EPISODE}/aligned.arrow":
            with (data / name).open("a") as rows:
                rows.write(", more")

    after_each_copy(monkeypatch, record)
    made, listed = copies(data, tmp_path / "copy")
    assert made.changing == [EPISODE]
    assert f"{EPISODE}/outcome.json" not in {each.path for each in listed}
    copy = (tmp_path / "copy" / EPISODE / "aligned.arrow").read_text()
    assert (data / EPISODE / "aligned.arrow").read_text().startswith(copy)
    assert next(each.bytes for each in listed if each.path.endswith("aligned.arrow")) == len(copy)


def test_a_file_that_is_removed_meanwhile_is_in_no_backup(data, tmp_path, monkeypatch):
    (data / "stations/bench/draft").write_text("x")
    after_each_copy(monkeypatch, lambda name: (data / "stations/bench/draft").unlink(missing_ok=True))
    _, listed = copies(data, tmp_path / "copy")
    assert not [each for each in listed if each.path.endswith("draft")]
    assert sorted(path.name for path in (tmp_path / "copy/stations/bench").iterdir()) == ["commands.jsonl"]


def test_a_disk_that_is_full_is_named(tmp_path, monkeypatch):
    (tmp_path / "from").write_text("x")

    def full(descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(BackupError, match="from: No space left on device; nothing was kept"):
        file_copies.copied(tmp_path / "from", tmp_path / "to", "from")


@pytest.mark.parametrize("line", ['{"path": "../../etc/passwd"}', "[]", "torn {", '{"path": 1}'])
def test_a_list_that_is_not_ours_is_refused(tmp_path, line):
    (tmp_path / "list").write_text(line + "\n")
    with pytest.raises(BackupError, match="line 1"):
        list(read_list(tmp_path / "list"))


def test_a_list_leads_nowhere_else(tmp_path):
    line = '{"path": "PATH", "bytes": 1, "sha256": "", "mode": 384, "mtime_ns": 1}\n'
    for path in ("../outside", "/etc/passwd", "a/../../b"):
        (tmp_path / "list").write_text(line.replace("PATH", path))
        with pytest.raises(BackupError, match="is not in a data folder"):
            list(read_list(tmp_path / "list"))


def test_the_index_of_what_is_in_the_store_is_copied_after_every_recording(data, tmp_path):
    (data / "archived").mkdir()
    (data / "archived" / "0b7c.json").write_text("{}")
    _, listed = copies(data, tmp_path / "copy")
    assert listed[-1].path == "archived/0b7c.json"
