"""System checks of the data folder and the proxy settings, run when a process starts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from django.conf import settings
from django.core.checks import CheckMessage, Error, Tags, Warning, register

from evaweb.core.environment import HUB_KEY, database_files, readable_by_others

RESTORING = ".restoring"  # folder in DATA with files that a restore has copied but not moved into place yet


@register(Tags.security)
def check_private_files(**options: Any) -> list[CheckMessage]:
    """Return a warning for each of data folder, database and keys that other accounts can read."""
    return [
        Warning(
            f"{path} can be read by others: {path.stat().st_mode & 0o777:o}",
            hint=f"chmod {'700' if path.is_dir() else '600'} {path}",
            id="evaweb.W001",
        )
        for path in _private()
        if path.exists() and readable_by_others(path)
    ]


@register()
def data_is_whole(**options: Any) -> list[CheckMessage]:
    """Return an error if a restore is running or was interrupted: the database then lacks its files."""
    draft = Path(settings.DATA_DIR) / RESTORING
    if not draft.exists():
        return []
    return [
        Error(
            f"{draft} is there: a backup is being put back, or that was cut off",
            hint="if no restore is running, empty the data folder and the database, and restore again",
            id="evaweb.E001",
        )
    ]


@register(Tags.security)
def check_declared_proxy(**options: Any) -> list[CheckMessage]:
    """Return a warning if HTTPS is on without a declared proxy: all logins then seem to come from one address."""
    if not settings.SESSION_COOKIE_SECURE or settings.EVA_PROXIES:
        return []
    return [
        Warning(
            "EVA_HTTPS is on and EVA_PROXIES is not given: wrong passwords of one person lock the name for everybody",
            hint="EVA_PROXIES=127.0.0.1 for a proxy on this machine; it has to send X-Forwarded-For",
            id="evaweb.W002",
        )
    ]


def _private() -> list[Path]:
    data = Path(settings.DATA_DIR)
    database = settings.DATABASES["default"]
    sqlite = database["ENGINE"].endswith("sqlite3")
    keys = [data / "secret_key", data / HUB_KEY]
    return [data, *keys, *(database_files(Path(database["NAME"])) if sqlite else [])]
