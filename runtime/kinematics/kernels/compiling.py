"""Compilation of loops by numba, for this processor, kept on disk so that a later process only loads them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

from runtime.kinematics import kernel_cache

try:
    import numba
except ImportError as missing:
    raise ImportError(
        "compiled kinematics need numba, which is not installed: pip install numba, or choose another [kinematics] kind"
    ) from missing

Loop = TypeVar("Loop", bound=Callable[..., Any])
_FAST = {"contract", "nsz"}  # fused multiply-add; no reordering, so that range reduction keeps its digits


def kernel(loop: Loop) -> Loop:
    """A loop that Python calls: compiled at its first call with each set of types, kept if a folder can be written."""
    made = numba.njit(cache=CACHE is not None, nogil=True, fastmath=_FAST, error_model="numpy")(loop)
    return cast(Loop, made)


def device_function(function: Loop) -> Loop:
    """Compiled function that is part of a kernel, compiled with it."""
    made = numba.njit(nogil=True, fastmath=_FAST, error_model="numpy", forceinline=True)(function)
    return cast(Loop, made)


CACHE = kernel_cache.folder()
if CACHE is not None:
    numba.config.CACHE_DIR = str(CACHE)  # type: ignore[attr-defined]
