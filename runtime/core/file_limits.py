"""Limit of the files and connections that a process may have open."""

from __future__ import annotations

import logging
import resource

log = logging.getLogger(__name__)
_ENOUGH = 4096


def raise_file_limit() -> None:
    """Raise the soft limit to the hard limit: ZMQ aborts a process that runs out of descriptors."""
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    if hard != resource.RLIM_INFINITY and hard < _ENOUGH:
        log.warning("only %d files may be open (ulimit -Hn): allow at least %d", hard, _ENOUGH)
