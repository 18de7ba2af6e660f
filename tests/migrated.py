"""An empty database with every table, made once by a process of the tests, for labs that begin with a copy of it."""

from __future__ import annotations

import atexit
import os
import shutil
import sqlite3
import subprocess
import sys
import tempfile
from contextlib import closing
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]


def copy(folder: Path) -> None:
    """Put it into the data folder of a lab."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    database = folder / "eva.sqlite3"
    shutil.copyfile(_made(), database)
    database.chmod(0o600)


@cache
def _made() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="eva-migrated-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    ours = {name: value for name, value in os.environ.items() if not name.startswith(("EVA_", "DJANGO_"))}
    subprocess.run(
        [sys.executable, "manage.py", "migrate", "--verbosity", "0"],
        cwd=ROOT,
        env=ours | {"EVA_DATA_DIR": str(folder)},
        check=True,
    )
    whole = folder / "whole.sqlite3"
    with closing(sqlite3.connect(folder / "eva.sqlite3")) as made, closing(sqlite3.connect(whole)) as copied:
        made.backup(copied)  # whatever its journal still has
    return whole
