"""Error of a backup, with a sentence for the administrator."""

from __future__ import annotations

from evaweb.core.errors import EvaError


class BackupError(EvaError):
    """Error if a backup cannot be created, read or restored."""
