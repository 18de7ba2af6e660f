"""Compilation of loops by numba for this processor, cached on disk for later processes."""

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
_FAST = {"contract", "nsz"}  # fused multiply-add; no reordering, which would spoil the range reduction


def kernel(loop: Loop) -> Loop:
    """Return the compiled form of a loop that Python calls.

    The loop is compiled at its first call with each combination of argument types. The result is cached on disk if
    there is a writable folder for the cache.
    """
    compiled = numba.njit(cache=CACHE is not None, nogil=True, fastmath=_FAST, error_model="numpy")(loop)
    return cast(Loop, compiled)


def device_function(function: Loop) -> Loop:
    """Compile a function that is inlined into kernels."""
    compiled = numba.njit(nogil=True, fastmath=_FAST, error_model="numpy", forceinline=True)(function)
    return cast(Loop, compiled)


CACHE = kernel_cache.folder()
if CACHE is not None:
    numba.config.CACHE_DIR = str(CACHE)  # type: ignore[attr-defined]
