"""An empty database with every table, made once, for labs and for tests that begin with a copy of it."""

from __future__ import annotations

import os
import shutil
import sqlite3
import subprocess
import sys
from contextlib import closing
from functools import cache
from pathlib import Path

from tests.once import made_once

ROOT = Path(__file__).parents[1]


def copy(folder: Path) -> None:
    """Put it into the data folder of a lab."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    copy_to(folder / "eva.sqlite3")


def copy_to(database: Path) -> None:
    """Put it there."""
    shutil.copyfile(_made(), database)
    database.chmod(0o600)


@cache
def _made() -> Path:
    return made_once("migrated", _make) / "whole.sqlite3"


def _make(folder: Path) -> None:
    ours = {name: value for name, value in os.environ.items() if not name.startswith(("EVA_", "DJANGO_"))}
    subprocess.run(
        [sys.executable, "manage.py", "migrate", "--verbosity", "0"],
        cwd=ROOT,
        env=ours | {"EVA_DATA_DIR": str(folder)},
        check=True,
    )
    with (
        closing(sqlite3.connect(folder / "eva.sqlite3")) as made,
        closing(sqlite3.connect(folder / "whole.sqlite3")) as copied,
    ):
        made.backup(copied)  # whatever its journal still has
