"""An empty database with every table, made once, for labs and for tests that begin with a copy of it.

`python -m tests.migrated` makes it beforehand: it is kept for as long as nothing that it is made of has changed.
"""

from __future__ import annotations

import hashlib
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
KEPT = ROOT / "build" / "migrated"


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
    kept = _kept()
    return kept if kept.exists() else made_once("migrated", _make) / "whole.sqlite3"


def _kept() -> Path:
    """Its place, which says what it is made of: our code, which migrations may use, and the versions of all else."""
    made_of = hashlib.sha256((ROOT / "constraints.txt").read_bytes())
    for path in sorted(ROOT.glob("evaweb/**/*.py")):
        made_of.update(path.relative_to(ROOT).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return KEPT / f"{made_of.hexdigest()}.sqlite3"


def _keep() -> None:
    kept = _kept()
    if kept.exists():
        return
    shutil.rmtree(KEPT, ignore_errors=True)
    draft = KEPT / f"draft-{os.getpid()}"
    draft.mkdir(0o700, parents=True)
    _make(draft)
    (draft / "whole.sqlite3").rename(kept)
    shutil.rmtree(draft)


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


if __name__ == "__main__":
    _keep()
