"""A lab's backup is made, verified and put back by the commands; what is damaged or not empty is refused."""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
import subprocess
import sys
from contextlib import closing

import pytest
from django.core.management import CommandError, call_command

from evaweb.core.file_checks import data_is_whole
from evaweb.lab.backups import backup, databases
from evaweb.lab.backups.errors import BackupError
from tests import migrated

OURS = {name: value for name, value in os.environ.items() if not name.startswith(("EVA_", "DJANGO_"))}


def manage(data, *arguments):
    done = subprocess.run(
        [sys.executable, "manage.py", *map(str, arguments)],
        cwd=migrated.ROOT,
        env=OURS | {"EVA_DATA_DIR": str(data)},
        capture_output=True,
        text=True,
    )
    return done.returncode, done.stdout + done.stderr


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lab") / "data"
    migrated.copy(folder)
    for name in ("scores/0b7c.jsonl", "deployments/bench.toml", "lab.lock", "previews/0b7c/top.mp4"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(name * 100)
    (folder / "scores/0b7c.jsonl").chmod(0o640)
    with closing(sqlite3.connect(folder / "eva.sqlite3")) as lab:
        lab.execute("INSERT INTO auth_group (name) VALUES ('benches')")
        lab.commit()
    return folder


def files(folder):
    return {
        str(path.relative_to(folder)): (path.read_bytes(), path.stat().st_mode, path.stat().st_mtime_ns)
        for path in folder.rglob("*")
        if path.is_file() and not path.name.startswith("eva.sqlite3") and path.name != "lab.lock"
    }


def dumped(database):
    with closing(sqlite3.connect(database)) as lab:
        return list(lab.iterdump())


@pytest.fixture(scope="module")
def whole(data):
    """A backup of it, made by the command while a writer has the database."""
    folder = data.with_name("backups")
    with closing(sqlite3.connect(data / "eva.sqlite3")) as writer:
        writer.execute("BEGIN IMMEDIATE")
        writer.execute("INSERT INTO auth_group (name) VALUES ('not committed')")
        code, said = manage(data, "backup", folder)
        writer.rollback()
    assert code == 0, said
    return folder


@pytest.fixture
def made(whole, tmp_path):
    """A copy of that backup, to be damaged."""
    shutil.copytree(whole, tmp_path / "backups")
    (found,) = backup.backups_in(tmp_path / "backups")
    return found


@pytest.mark.exhaustive
def test_every_row_and_file_comes_back(data, made, tmp_path):
    assert backup.verify(made.path, quiet)[1] == []
    again = tmp_path / "again"
    code, said = manage(again, "restore", made.path)
    assert (code, "every file and table compared" in said) == (0, True), said
    assert files(again) == files(data)
    assert dumped(again / "eva.sqlite3") == dumped(data / "eva.sqlite3")
    assert "benches" in "".join(dumped(again / "eva.sqlite3"))
    assert [path.name for path in again.iterdir() if path.name.startswith(".")] == []
    for path in (made.path, *made.path.rglob("*")):
        assert path.stat().st_mode & 0o077 == 0, f"{path} can be read by others"

    code, said = manage(again, "restore", made.path)
    assert code == 1
    assert "has tables: a backup is put back into an empty lab" in said


def quiet(part):
    """Nobody listens to what is copied."""


def damaged(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize("name", ["files/scores/0b7c.jsonl", "database.sqlite3", "files.jsonl"])
def test_one_changed_bit_is_found(made, name):
    damaged(made.path / name)
    _, problems = backup.verify(made.path, quiet)
    assert [problem for problem in problems if f"{name} is not as it was written" in problem]
    if not name.startswith(backup.FILES + "/"):
        with pytest.raises(BackupError, match=f"{name} is not as it was written"):
            backup.restore(made.path, quiet)


@pytest.mark.exhaustive
def test_a_changed_file_is_never_put_back(made, tmp_path):
    damaged(made.path / "files/scores/0b7c.jsonl")
    code, said = manage(tmp_path / "again", "restore", made.path)
    assert (code, "0b7c.jsonl is not as it was written; nothing was put back" in said) == (1, True), said
    assert {path.name for path in (tmp_path / "again").iterdir()} <= {"secret_key", "lab_id", "eva.sqlite3"}
    assert "CREATE TABLE" not in "".join(dumped(tmp_path / "again/eva.sqlite3"))


def test_what_is_absent_is_named(made):
    (made.path / "files/deployments/bench.toml").unlink()
    _, problems = backup.verify(made.path, quiet)
    assert problems == [f"{made.path}/files/deployments/bench.toml: No such file or directory"]
    made.database.unlink()
    assert f"{made.database} is not there" in backup.verify(made.path, quiet)[1]


def test_a_backup_of_a_later_version_or_another_engine_is_refused(made, tmp_path):
    about = json.loads((made.path / backup.ABOUT).read_text())
    for change, words in (
        (
            {"migrations": [*about["database"]["migrations"], "trials/0999_later"]},
            "trials/0999_later; install that version first",
        ),
        ({"engine": "postgresql"}, "is of postgresql, the settings' database is sqlite3"),
    ):
        (made.path / backup.ABOUT).write_text(json.dumps(about | {"database": about["database"] | change}))
        with pytest.raises(BackupError, match=words):
            backup.restore(made.path, quiet)
    for text, words in (
        ("{}", "cannot be read"),
        ('{"format": 2}', "format 2; this program reads 1"),
        ("[", "cannot be read"),
    ):
        (made.path / backup.ABOUT).write_text(text)
        with pytest.raises(BackupError, match=words):
            backup.Backup.at(made.path)


def test_a_folder_that_holds_backups_says_which(made):
    with pytest.raises(BackupError, match=f"is no whole backup.*in it are {made.path.name}: name one"):
        backup.Backup.at(made.path.parent)


@pytest.mark.exhaustive
def test_the_oldest_go_and_what_a_kill_left(data, made):
    (made.path.parent / "2026-01-01T000000.000000Z.partial").mkdir()
    code, said = manage(data, "backup", made.path.parent, "--keep", "1")
    assert code == 0, said
    assert [
        path.name for path in made.path.parent.iterdir() if path == made.path or path.suffix == ".partial"
    ] == []


def test_a_place_or_a_number_that_cannot_be_is_refused(data, settings):
    settings.DATA_DIR = data
    with pytest.raises(CommandError, match="is in the data folder: name a folder elsewhere"):
        call_command("backup", str(data / "backups"))
    with pytest.raises(CommandError, match="'0'; allowed: whole numbers from 1"):
        call_command("backup", "x", "--keep", "0")


def test_nothing_starts_on_half_a_restore(tmp_path, settings):
    settings.DATA_DIR = tmp_path
    assert data_is_whole() == []
    (tmp_path / ".restoring").mkdir()
    assert [found.id for found in data_is_whole()] == ["evaweb.E001"]


def test_a_database_that_no_one_can_back_up_is_named():
    with pytest.raises(BackupError, match="mysql cannot be backed up; allowed: sqlite3, postgresql"):
        databases.of("mysql")
