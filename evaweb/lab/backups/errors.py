"""Fault of a backup, with a sentence for the administrator."""

from __future__ import annotations

from evaweb.errors import EvaError


class BackupError(EvaError):
    """It cannot be made, read or put back."""
