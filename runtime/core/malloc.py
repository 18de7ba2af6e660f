"""Memory that a process frees stays with it, because pictures come and go.

glibc gives large pieces of freed memory back to the kernel, and each picture then begins with a page fault for every
4 kB of it: of a request with three small pictures that is half of the processor time. Nothing grows by this: the
process keeps what it has needed at most at one time.
"""

from __future__ import annotations

import ctypes

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of mallopt(3)
_KEPT = 256 * 1024 * 1024  # bytes of free memory in one piece; more is given back
_FROM_THE_HEAP = (
    32 * 1024 * 1024
)  # bytes; the most that glibc takes. Larger pieces come from the kernel and go there


def keep_freed_memory() -> bool:
    """Ask for it; False where the C library has no such setting."""
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except AttributeError:  # musl
        return False
    return bool(mallopt(_M_TRIM_THRESHOLD, _KEPT)) and bool(mallopt(_M_MMAP_THRESHOLD, _FROM_THE_HEAP))
