"""Version of this installation, for display."""

from __future__ import annotations

from functools import cache
from importlib.metadata import PackageNotFoundError
from importlib.metadata import version as installed


@cache  # cache: it is looked up on the disk, and the program that runs stays what it is
def version() -> str:
    """Return the installed version; "unknown" in a checkout that is not installed."""
    try:
        return installed("eva-web")
    except PackageNotFoundError:
        return "unknown"
