"""Error of a backup, with a sentence for the administrator."""

from __future__ import annotations

from evaweb.core.errors import EvaError


class BackupError(EvaError):
    """A backup cannot be created, read or restored."""
