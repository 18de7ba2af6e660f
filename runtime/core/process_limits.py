"""Limits that a process sets for itself: open files and connections, and memory that it keeps for reuse."""

from __future__ import annotations

import ctypes
import logging
import resource

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of mallopt(3)
_KEPT = 256 * 1024 * 1024  # [bytes] free memory at the top of the heap that is not returned
_FROM_THE_HEAP = 32 * 1024 * 1024  # [bytes] glibc's maximum; larger blocks are mapped


def keep_freed_memory() -> bool:
    """Let glibc reuse freed memory instead of returning it; return False if the C library does not support it.

    For processes that handle pictures. glibc returns large freed blocks to the kernel, so each new picture causes a
    page fault per 4 kB: half of the processor time of a request with three small pictures. Memory does not grow: the
    process holds its peak use at most.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except AttributeError:  # musl
        return False
    return bool(mallopt(_M_TRIM_THRESHOLD, _KEPT)) and bool(mallopt(_M_MMAP_THRESHOLD, _FROM_THE_HEAP))


log = logging.getLogger(__name__)
_ENOUGH = 4096


def raise_file_limit() -> None:
    """Raise the soft limit of open files to the hard limit: ZMQ aborts a process that runs out of descriptors."""
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    if hard != resource.RLIM_INFINITY and hard < _ENOUGH:
        log.warning("only %d files may be open (ulimit -Hn): allow at least %d", hard, _ENOUGH)
