"""Modes of the files with passwords and sessions, their user's alone: looked at when a process starts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from django.conf import settings
from django.core.checks import CheckMessage, Tags, Warning, register

from evaweb.environment import beside, readable_by_others


@register(Tags.security)
def data_is_private(**options: Any) -> list[CheckMessage]:
    """Others cannot read the data folder, the database and the key."""
    return [
        Warning(
            f"{path} can be read by others: {path.stat().st_mode & 0o777:o}",
            hint=f"chmod {'700' if path.is_dir() else '600'} {path}",
            id="evaweb.W001",
        )
        for path in _private()
        if path.exists() and readable_by_others(path)
    ]


@register(Tags.security)
def proxy_is_declared(**options: Any) -> list[CheckMessage]:
    """Behind an undeclared proxy all logins come from one address."""
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
    return [data, data / "secret_key", *(beside(Path(database["NAME"])) if sqlite else [])]
