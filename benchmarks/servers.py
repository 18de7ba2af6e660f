"""Separate PostgreSQL and Redis servers in temporary folders, which can be crashed and started again."""

from __future__ import annotations

import os
import pwd
import secrets
import shutil
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

_PLACES = sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)
_USER = "postgres"  # the server refuses to run as root
_START_S = 20.0


@dataclass(frozen=True, slots=True)
class Server:
    """Running server with its address; `crash` ends it without a shutdown and starts it again on the same data."""

    url: str
    crash: Callable[[], None]


def why_no_postgresql() -> str:
    """Return why a PostgreSQL server cannot run here, "" if it can."""
    if find_spec("psycopg") is None:
        return "the driver psycopg is not installed"
    if _program("initdb") is None:
        return "initdb is not installed"
    if os.geteuid() == 0 and not any(row.pw_name == _USER for row in pwd.getpwall()):
        return f"the server cannot run as root, and there is no user {_USER}"
    return ""


def why_no_redis() -> str:
    """Return why a Redis server cannot run here, "" if it can."""
    return "" if shutil.which("redis-server") else "redis-server is not installed"


@contextmanager
def postgresql(folder: Path) -> Iterator[Server]:
    """Yield a PostgreSQL server at a socket in `folder`; its durability settings are PostgreSQL's defaults."""
    folder.mkdir()
    if os.geteuid() == 0:
        shutil.chown(folder, _USER)
        for parent in folder.parents:
            if parent.stat().st_uid == 0 and parent.stat().st_mode & 0o777 == 0o700:
                parent.chmod(0o711)  # only the scratch folder of this program
    data = folder / "data"
    _run("initdb", "-D", str(data), "-U", "eva", "-A", "trust", "-E", "UTF8")
    options = f"-k {folder} -c listen_addresses='' -c fsync=on"

    def start() -> None:
        _run("pg_ctl", "-D", str(data), "-o", options, "-l", str(folder / "log"), "-w", "start")

    def crash() -> None:
        _run("pg_ctl", "-D", str(data), "-m", "immediate", "-w", "stop")
        start()

    start()
    try:
        _run("createdb", "-h", str(folder), "-U", "eva", "eva")
        yield Server(f"postgres://eva@{str(folder).replace('/', '%2F')}/eva", crash)
    finally:
        _run("pg_ctl", "-D", str(data), "-m", "fast", "-w", "stop")


@contextmanager
def redis(folder: Path) -> Iterator[Server]:
    """Yield a Redis server on a free port of loopback, with a password, that appends every write to its file."""
    folder.mkdir()
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    password = secrets.token_urlsafe(16)
    configuration = folder / "redis.conf"
    configuration.write_text(
        f'bind 127.0.0.1\nport {port}\ndir {folder}\nrequirepass "{password}"\n'
        'appendonly yes\nappendfsync always\nsave ""\n'
    )
    child: subprocess.Popen[bytes] | None = None

    def start() -> None:
        nonlocal child
        child = subprocess.Popen(["redis-server", str(configuration)], stdout=subprocess.DEVNULL)
        until = time.monotonic() + _START_S
        while time.monotonic() < until:
            try:
                socket.create_connection(("127.0.0.1", port), 1.0).close()
                return
            except ConnectionRefusedError:
                time.sleep(0.05)
        raise SystemExit(f"redis-server does not listen within {_START_S:g} s")

    def crash() -> None:
        assert child is not None
        child.kill()
        child.wait()
        start()

    start()
    try:
        yield Server(f"redis://:{password}@127.0.0.1:{port}/0", crash)
    finally:
        assert child is not None
        child.terminate()
        child.wait(_START_S)


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
