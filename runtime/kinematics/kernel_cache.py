"""Cache of compiled kernels on disk, and records of the robots for which it is complete; this module loads no
compiler.
"""

from __future__ import annotations

import functools
import hashlib
import json
import logging
import os
import tempfile
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from robots import Robot

_KERNELS = Path(__file__).resolve().parent / "kernels"


@functools.cache  # cache: one process compiles into one folder
def folder() -> Path | None:
    """Return the first writable folder for the cache, None if there is none.

    It is below $NUMBA_CACHE_DIR, or next to the sources, or in the user's cache.
    """
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    home = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser()
    roots = [Path(chosen)] if chosen else [_KERNELS / "__pycache__", home / "eva-web"]
    for root in roots:
        path = root / f"kernels-{_digest()}"
        try:
            path.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=path).close()
        except OSError:
            continue
        return path
    logging.getLogger(__name__).warning(
        "compiled kinematics are kept in memory alone, and every start takes seconds longer: %s cannot be written; "
        "name a folder in NUMBA_CACHE_DIR",
        " and ".join(map(str, roots)),
    )
    return None


def is_compiled(robot: Robot) -> bool:
    """Return True if the robot's kernels are on disk, so that they load within a second, without compilation."""
    cache = folder()
    if cache is None:
        return False
    try:
        noted = json.loads((cache / _name(robot)).read_text("utf-8"))
    except (OSError, ValueError):
        return False
    stored = _kernels(cache)
    return bool(noted) and all(stored.get(name) == size for name, size in noted.items())


def note_compiled(robot: Robot) -> None:
    """Record that the robot's kernels are on disk, with names and sizes of their files."""
    if (cache := folder()) is not None:
        part = cache / f"{_name(robot)}.{os.getpid()}"
        part.write_text(json.dumps(_kernels(cache)), "utf-8")
        part.replace(cache / _name(robot))


def load(call: Callable[[], object]) -> None:
    """Load kernels by a call of them, which compiles those that are not cached.

    A cached kernel that cannot be read (a full disk, a power failure) is compiled again.
    """
    try:
        call()
    except Exception as error:
        if not forget():
            raise
        logging.getLogger(__name__).warning(
            "compiled kernels cannot be used as they are kept (%s: %s); compiling them again",
            type(error).__name__,
            error,
        )
        call()


def forget() -> bool:
    """Remove all cached files, so that they are compiled again; return False if there were none."""
    cache = folder()
    files = [] if cache is None else [file for file in cache.rglob("*") if file.is_file()]
    for file in files:
        file.unlink(missing_ok=True)
    return bool(files)


def _kernels(cache: Path) -> dict[str, int]:
    """Return the sizes [bytes] of the files with machine code, by name.

    A file counts only if numba's index file for its function exists too and is not empty.
    """
    return {
        file.relative_to(cache).as_posix(): file.stat().st_size
        for file in sorted(cache.rglob("*.nbc"))
        if any(index.stat().st_size for index in file.parent.glob(f"{_function(file)}*.nbi"))
    }


def _function(file: Path) -> str:
    """Return the part of a numba file's name that identifies a function.

    The name is MODULE.FUNCTION-LINE.PYTHON.NUMBER.nbc; the part is what precedes NUMBER.
    """
    return file.name.rpartition(".nbc")[0].rpartition(".")[0]


def _digest() -> str:
    """Return a digest of the sources of all kernels.

    It is needed because numba compares only a function's own file, and would use outdated functions that it calls.
    """
    digest = hashlib.sha256()
    for file in sorted(_KERNELS.glob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def _name(robot: Robot) -> str:
    """Return the file name of the robot's record, which depends on its model, the compiler and the processor."""
    digest = hashlib.sha256(robot.urdf.read_bytes())
    for part in (robot.joint_names, _numba(), _processor()):
        digest.update(repr(part).encode())
    return f"{robot.name}-{digest.hexdigest()[:16]}.compiled"


def _numba() -> str:
    try:
        return version("numba")
    except PackageNotFoundError:
        return ""


@functools.cache  # cache: it stays the same
def _processor() -> list[str]:
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8", "replace").splitlines()
    except OSError:
        return []
    return sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))})
