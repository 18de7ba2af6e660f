"""Packs the data folder of a lab of one version for the test of upgrades:

    python tests/evaweb/upgrades/make.py DATA VERSION

after, with that version,

    EVA_DATA_DIR=DATA python manage.py demo --port 0 --evaluate 2 --pictures 400x300 --design early

One recording stays, the shortest; secrets, previews, datasets, logs and what belongs to processes do not.
"""

from __future__ import annotations

import json
import shutil
import sqlite3
import sys
import tarfile
import tempfile
from contextlib import closing
from pathlib import Path

KEPT = ("eva.sqlite3", "lab_id", "episodes", "scores", "pictures", "reveals", "jobs")


def pack(data: Path, version: str) -> Path:
    """The archive, beside this file."""
    target = Path(__file__).with_name(f"{version}.tar.xz")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for kept in KEPT:
            if (data / kept).is_dir():
                shutil.copytree(data / kept, folder / kept)
        shutil.copy(data / "lab_id", folder)
        with closing(sqlite3.connect(data / "eva.sqlite3")) as lab:
            lab.execute("VACUUM INTO ?", [str(folder / "eva.sqlite3")])
        _, *others = sorted((folder / "episodes").iterdir(), key=_size)
        for other in others:
            shutil.rmtree(other)
        (folder / "expected.json").write_text(json.dumps(_facts(folder / "eva.sqlite3"), indent=1), "utf-8")
        with tarfile.open(target, "w:xz") as archive:
            for path in sorted(folder.iterdir()):
                archive.add(path, path.name, filter=_plain)
    return target


def _facts(database: Path) -> dict[str, object]:
    """What has to be there afterwards, as that version's tables say it."""
    with closing(sqlite3.connect(database)) as lab:
        tables = [name for (name,) in lab.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        return {
            "rows": {
                name: lab.execute(f"SELECT count(*) FROM {name}").fetchone()[0]
                for name in tables
                if not name.startswith(("django_", "sqlite_"))
            },
            "scores": lab.execute("SELECT uuid, success, score FROM trials_score ORDER BY uuid").fetchall(),
            "plans": lab.execute(
                "SELECT name, version, state, digest FROM plans_plan ORDER BY name, version"
            ).fetchall(),
            "episodes": lab.execute("SELECT uuid, frames FROM episodes_episode ORDER BY uuid").fetchall(),
        }


def _size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*"))


def _plain(entry: tarfile.TarInfo) -> tarfile.TarInfo:
    entry.uid = entry.gid = 0
    entry.uname = entry.gname = ""
    return entry


if __name__ == "__main__":
    print(pack(Path(sys.argv[1]), sys.argv[2]))
