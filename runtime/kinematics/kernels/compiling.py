"""Compilation of loops by numba, for this processor, kept on disk so that a later process only loads them."""

from __future__ import annotations

import hashlib
import logging
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

try:
    import numba
except ImportError as missing:
    raise ImportError(
        "compiled kinematics need numba, which is not installed: pip install numba, or choose another [kinematics] kind"
    ) from missing

Loop = TypeVar("Loop", bound=Callable[..., Any])
_HERE = Path(__file__).resolve().parent
_FAST = {"contract", "nsz"}  # fused multiply-add; no reordering, so that range reduction keeps its digits


def kernel(loop: Loop) -> Loop:
    """A loop that Python calls: compiled at its first call with each set of types, kept if a folder can be written."""
    made = numba.njit(cache=CACHE is not None, nogil=True, fastmath=_FAST, error_model="numpy")(loop)
    return cast(Loop, made)


def part(function: Loop) -> Loop:
    """Compiled function that is part of a kernel, compiled with it."""
    made = numba.njit(nogil=True, fastmath=_FAST, error_model="numpy", forceinline=True)(function)
    return cast(Loop, made)


def _digest() -> str:
    """Of all sources here: numba looks at a loop's own file alone, and would go on using what an old callee was."""
    found = hashlib.sha256()
    for file in sorted(_HERE.glob("*.py")):
        found.update(file.read_bytes())
    return found.hexdigest()[:16]


def _cache() -> Path | None:
    """The first folder that can be written: below $NUMBA_CACHE_DIR, beside the sources, in the user's cache."""
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    home = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser()
    roots = [Path(chosen)] if chosen else [_HERE / "__pycache__", home / "eva-web"]
    for root in roots:
        folder = root / f"kernels-{_digest()}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
        except OSError:
            continue
        return folder
    logging.getLogger(__name__).warning(
        "compiled kinematics are kept in memory alone, and every start takes seconds longer: %s cannot be written; "
        "name a folder in NUMBA_CACHE_DIR",
        " and ".join(map(str, roots)),
    )
    return None


def is_kept() -> bool:
    """True if something compiled is on disk; what is not has to be compiled, for seconds."""
    return CACHE is not None and any(CACHE.rglob("*.nbi"))


def forget() -> bool:
    """Remove what is kept on disk, so that it is compiled again; False where nothing is."""
    kept = [] if CACHE is None else [file for file in CACHE.rglob("*") if file.is_file()]
    for file in kept:
        file.unlink(missing_ok=True)
    return bool(kept)


CACHE = _cache()
if CACHE is not None:
    numba.config.CACHE_DIR = str(CACHE)  # type: ignore[attr-defined]
