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
    return _compile(loop, fastmath=_FAST, cache=CACHE is not None)


def device_function(function: Loop) -> Loop:
    """Compile a function that is inlined into kernels."""
    return _compile(function, fastmath=_FAST, forceinline=True)


def exact_kernel(loop: Loop) -> Loop:
    """Return the compiled form of a loop as `kernel` does, with each floating-point operation as it is written.

    It cannot create arrays, and therefore does not count references to those that it is given: in a loop over pixels
    this would be most of the work.
    """
    return _compile(loop, cache=CACHE is not None, _nrt=False)


def exact_function(function: Loop) -> Loop:
    """Compile a function that is inlined into exact kernels."""
    return _compile(function, forceinline=True, _nrt=False)


def _compile(function: Loop, **options: Any) -> Loop:
    return cast(Loop, numba.njit(nogil=True, error_model="numpy", **options)(function))


CACHE = kernel_cache.folder()
if CACHE is not None:
    numba.config.CACHE_DIR = str(CACHE)  # type: ignore[attr-defined]
