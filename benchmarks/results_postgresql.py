"""Separate PostgreSQL server in a temporary folder, which is reached by a socket in that folder."""

from __future__ import annotations

import os
import pwd
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

_PLACES = sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)
_USER = "postgres"  # the server refuses to run as root


def why_not() -> str:
    """Return why a server cannot run here, "" if it can."""
    if find_spec("psycopg") is None:
        return "the driver psycopg is not installed"
    if _program("initdb") is None:
        return "initdb is not installed"
    if os.geteuid() == 0 and not any(row.pw_name == _USER for row in pwd.getpwall()):
        return f"the server cannot run as root, and there is no user {_USER}"
    return ""


@contextmanager
def server(folder: Path) -> Iterator[str]:
    """Yield the server's address for DATABASE_URL; its durability settings are PostgreSQL's defaults."""
    folder.mkdir()
    if os.geteuid() == 0:
        shutil.chown(folder, _USER)
        for parent in folder.parents:
            if parent.stat().st_uid == 0 and parent.stat().st_mode & 0o777 == 0o700:
                parent.chmod(0o711)  # only the scratch folder of this program
    data = folder / "data"
    _run("initdb", "-D", str(data), "-U", "eva", "-A", "trust", "-E", "UTF8")
    options = f"-k {folder} -c listen_addresses='' -c fsync=on"
    _run("pg_ctl", "-D", str(data), "-o", options, "-l", str(folder / "log"), "-w", "start")
    try:
        _run("createdb", "-h", str(folder), "-U", "eva", "eva")
        yield f"postgres://eva@{str(folder).replace('/', '%2F')}/eva"
    finally:
        _run("pg_ctl", "-D", str(data), "-m", "fast", "-w", "stop")


def _program(name: str) -> str | None:
    path = next((place / name for place in _PLACES if (place / name).exists()), None)
    return str(path) if path else shutil.which(name)


def _run(name: str, *words: str) -> None:
    program = _program(name)
    if program is None:
        raise SystemExit(f"{name} is not installed")
    user = _USER if os.geteuid() == 0 else None
    completed = subprocess.run(
        [program, *words], user=user, cwd="/", capture_output=True, text=True, check=False
    )
    if completed.returncode:
        raise SystemExit(f"{name} failed: {completed.stderr or completed.stdout}")
